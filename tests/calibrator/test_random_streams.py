from itertools import product

from calibrator.random_streams import Purpose, random_stream


def test_stream_is_decided_by_its_purpose_and_numbers_and_differs_from_all_others() -> None:
    numbers = [(), (0,), (7,), (7, 0), (7, 0, 0), (0, 7)]
    first, again = ([random_stream(p, *n).random() for p, n in product(Purpose, numbers)] for _ in range(2))
    assert first == again
    assert len(set(first)) == len(first)
