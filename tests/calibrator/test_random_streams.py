from itertools import combinations, product

from calibrator.random_streams import Purpose, random_stream


def test_streams_of_different_purposes_and_numbers_all_differ() -> None:
    numbers = [(), (0,), (7,), (7, 0), (7, 0, 0), (0, 7), (1, 7)]
    first = {(p, n): random_stream(p, *n).integers(0, 2**63) for p, n in product(Purpose, numbers)}
    assert all(first[a] != first[b] for a, b in combinations(first, 2))


def test_same_arguments_give_the_same_stream() -> None:
    assert random_stream(Purpose.FAULTS, 3).random() == random_stream(Purpose.FAULTS, 3).random()
