import pytest

from bench.posterior import rows


@pytest.mark.long
def test_figures_of_the_posterior_stand_beside_those_of_basis_pursuit() -> None:
    figures = {row.name: row for row in rows(quick=True)}
    beside = [f"posterior, K = {K}, S = {S} %" for K in (2, 4) for S in (80, 60)]
    alone = [f"posterior, K = {K}, S = {S} %" for K in (3, 5, 6, 8) for S in (80, 60)]
    assert {name for name, row in figures.items() if row.peer is not None} == set(beside)
    assert set(alone) < set(figures)
    assert len(figures) == len(beside) + len(alone) + 1, "and the whole fleet"
    assert all(row.value > 0.0 for row in figures.values())
