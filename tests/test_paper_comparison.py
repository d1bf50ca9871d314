# SPDX-License-Identifier: Apache-2.0
"""What `python -m benchmarks paper` rests on: its continuous reference, its lead matrices and its plain pivoting."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import DEVICE

from benchmarks import lead_matrix as lead
from benchmarks import paper, paper_picture, report

ROOT = Path(__file__).parents[1]
CASES = {case.name: case for case in (*paper.CASES, *paper.PIVOTED)}


def test_the_continuous_motion_rests_where_it_is_published():
    """Two independent codes agree on these numbers to 1e-9 (tests/test_paper_box.py)."""
    pytest.importorskip("scipy")
    rest = paper.reference(np.array([paper.DURATION]))[0]
    np.testing.assert_allclose(rest, [0.4406458032, 1.5839676389, 1.9534724273], atol=2e-9)


def test_the_continuous_motion_is_that_of_the_reference_trajectory(shared):
    pytest.importorskip("scipy")
    table = np.genfromtxt(shared / "references" / "box_on_ground_reference.csv", delimiter=",", names=True, skip_header=3)
    expected = np.column_stack([table["x"], table["y"], table["yaw"]])
    np.testing.assert_allclose(paper.reference(table["t"]), expected, atol=2e-9)


def steps(name, h=1e-2, count=4):
    """Simulator after a few steps of the sliding box, and its rows."""
    sim = CASES[name].simulator(h, DEVICE)
    sim.step(count)
    return sim, lead.rows(sim)


@pytest.mark.parametrize("name", ["facets, k = 2", "facets, k = 4", "aligned", "regularized", "AP, k = 2", "AP, k = 4", "box"])
def test_the_law_is_judged_as_the_simulator_judges_it(name):
    """The certificate written anew, with polygons: of the answer the same to round-off, of no impulse at all far from solved."""
    sim, rows = steps(name)
    velocity = rows.free_velocity + rows.response @ rows.applied
    np.testing.assert_allclose(velocity, sim.v.numpy()[0], atol=1e-12)
    assert lead.residual(rows, rows.applied) == pytest.approx(sim.residual.numpy()[0], rel=1e-3, abs=1e-12)
    assert lead.residual(rows, 0 * rows.applied) > 1e-3


@pytest.mark.parametrize("name", ["facets, k = 2", "facets, k = 3", "aligned", "regularized", "AP, k = 2", "AP, k = 4", "box"])
def test_every_lcp_is_that_of_its_law(name):
    """Lemke's answer obeys the law and moves the box as the simulator's method does, which never saw this matrix."""
    _, rows = steps(name)
    problem = CASES[name].problem(rows)
    (z,) = lead.solve([problem], "lemke")
    p = problem.P @ z + problem.p_0
    assert lead.residual(rows, p) < lead.SOLVED
    np.testing.assert_allclose(rows.response @ p, rows.response @ rows.applied, atol=1e-6)


def test_ranks():
    """Ref. 6 counts every direction twice and every contact's slip on top: 4 + 8 of 12 rows of W, 3 of 4 gammas. The paper's LCP
    is of full rank, and short of one for each direction of a contact without phantom inertia."""
    _, rows = steps("AP, k = 2")
    assert lead.rank(lead.anitescu_potra(rows).M)[0] == 15
    for k in (2, 4):
        _, rows = steps(f"facets, k = {k}")
        n = 4 * (1 + 2 * k)
        assert lead.rank(lead.equilibrated(lead.phantom_inertia(rows).M))[0] == n
        assert lead.rank(lead.equilibrated(lead.phantom_inertia(rows, 0.0).M))[0] <= n - 4 * k
        assert lead.rank(lead.equilibrated(lead.phantom_inertia(rows, None, 0.0).M))[0] <= n - 4 * k


def test_block_pivoting_solves_problems_that_have_one_solution():
    """Diagonally dominant M: it ends, at the only solution."""
    rng = np.random.default_rng(0)
    for n in (1, 5, 30):
        M = rng.normal(size=(n, n))
        M[np.diag_indices(n)] = np.abs(M).sum(axis=1) + 1.0
        z = np.maximum(rng.normal(size=n), 0.0)
        q = np.where(z > 0.0, 0.0, rng.uniform(0.1, 1.0, n)) - M @ z
        found, singular = lead.block_pivoting(lead.Problem(M, q, np.eye(n), np.zeros(n)))
        np.testing.assert_allclose(found, z, atol=1e-9)
        assert not singular


def test_block_pivoting_says_so_where_it_goes_round_in_circles():
    """A P-matrix, hence one solution, (1, 1, 0); exchanging all infeasible pairs returns to where it was."""
    M = np.array([[1.0, 2.0, 3.0], [-2.0, 1.0, 3.0], [-1.0, 0.0, 1.0]])
    problem = lead.Problem(M, np.array([-3.0, 1.0, 2.0]), np.eye(3), np.zeros(3))
    assert np.isnan(lead.block_pivoting(problem)[0]).all()


@pytest.mark.parametrize("alpha", [1e-6, 1.0])
@pytest.mark.parametrize(("k", "expected"), [(2, False), (3, True), (4, True), (8, True)])
def test_the_first_block_is_singular_with_more_than_two_directions(k, expected, alpha):
    """One of w_up, w_lo enters for every direction of a contact; E n = 0 has solutions from k = 3 on, and rho is not in that block."""
    _, rows = steps(f"facets, k = {k}")
    problem = lead.phantom_inertia(rows, alpha)
    entering = np.ix_(problem.q < 0.0, problem.q < 0.0)
    assert len(problem.M[entering]) >= 4 * k
    assert (lead.rank(lead.equilibrated(problem.M)[entering])[0] < len(problem.M[entering])) == expected


def test_tables_go_between_their_marks(tmp_path):
    path = tmp_path / "paper.md"
    path.write_text(f"before\n{report.begin('paper')}old\n{report.END}after\n")
    report.document("paper", "new", path)
    assert path.read_text() == f"before\n{report.begin('paper')}\nnew\n{report.END}after\n"
    path.write_text("no marks\n")
    with pytest.raises(ValueError, match="marks"):
        report.document("paper", "new", path)
    report.document("paper", "new", tmp_path / "nowhere" / "paper.md")  # a whole run must not end for want of a document
    assert report.tables("paper", tmp_path / "nowhere" / "paper.md") == "new"


def results():
    """What the tables and the picture in docs were made of."""
    return json.loads(sorted((ROOT / "benchmarks" / "results").glob("*-paper-cpu.json"))[-1].read_text())


def test_the_document_holds_the_tables_of_the_results():
    assert report.tables("paper", ROOT / "docs" / "paper.md") == paper.markdown(results())


def test_the_picture_is_that_of_the_results(tmp_path):
    """The same data give the same file, other data another."""
    pytest.importorskip("matplotlib")
    data = results()
    for name in ("a", "b"):
        paper_picture.draw(data, tmp_path / name)
    first, second = (tmp_path / f"{name}.svg" for name in ("a", "b"))
    assert first.read_bytes() == second.read_bytes()
    assert (tmp_path / "a.png").stat().st_size > 50_000
    data["formulations"][0]["trajectory"][-1][0] += 0.1
    paper_picture.draw(data, tmp_path / "b")
    assert first.read_bytes() != second.read_bytes()
