"""Figures 2 to 4 and the errata: the parts of scripts/reproduce.py run, and their figures say what the pages say."""

import itertools
import json
from pathlib import Path

import pytest
import torch
from studies.reproduction import errata, sensitivity, sinusoids, tip_sensitivity
from studies.reproduction.cases import L, steel_rod

from tests.robots import T
from torchrod import PointForces, solve_shape

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    folder = tmp_path_factory.mktemp("figure2")
    return folder, *sinusoids.run(True, folder)


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    folder = tmp_path_factory.mktemp("figure3")
    return folder, *sensitivity.run(True, folder)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    folder = tmp_path_factory.mktemp("errata")
    return folder, *errata.run(True, folder)


@pytest.mark.parametrize("part", ["two", *(pytest.param(p, marks=pytest.mark.study) for p in ("three", "wrong"))])
@pytest.mark.many_fits
def test_pictures_and_data(part, request):
    folder, data, lines = request.getfixturevalue(part)
    assert json.loads(json.dumps(data)) == data, "plain numbers"
    page = "\n".join(lines)
    for name in {"two": ["figure2.png"], "three": ["figure3.png", "figure4.png"], "wrong": ["errata.md"]}[part]:
        assert f"({name})" in page
        assert (folder / name).stat().st_size > 5000


def test_sinusoidal_loads(two):
    data = two[1]
    assert abs(data["supported_slope"] + 4) < 0.01
    assert abs(data["clamped_slope"] + 1) < 0.1
    for key in ("supported_off", "clamped_off", "shear_off"):
        assert data[key] < 1e-6, key
    assert abs(data["shear_at_n_10"] - 0.002) < 1e-4
    assert abs(data["printed_over_solver"] / data["EI_Nm2"] ** 2 - 1) < 1e-6


def test_the_papers_figure_2(two):
    """RMS sqrt(2) A / (2 EI omega^4) at A = 16 pi^4 N/m and EI = 1: 8 sqrt(2) / N^4 m; and the solver agrees."""
    for n in (2, 4, 20):
        assert abs(two[1][f"figure2_rms_m_N_{n}"] / (8 * 2**0.5 / n**4) - 1) < 1e-12
    assert two[1]["figure2_off"] < 1e-5


def test_equation_7_is_the_derivative_of_equation_6():
    F, mu, h = T([0.5, 2.0]), T([0.3, 0.8]), 1e-6

    def delta(F, mu):
        return F * (3 * mu**2 - mu**3) / 6

    by_force, by_place = tip_sensitivity.beam_by_tip(F, mu)
    assert torch.allclose(1 / by_force, (delta(F + h, mu) - delta(F - h, mu)) / (2 * h), rtol=1e-8)
    assert torch.allclose(1 / by_place, (delta(F, mu + h) - delta(F, mu - h)) / (2 * h), rtol=1e-8)


@pytest.mark.study
def test_the_papers_figure_4(three):
    """(8) meets (7) while the rod is straight, and exceeds it the more the larger the force; more points lower it."""
    tip = three[1]["tip"]
    for row in tip["at_1_mN"].values():
        assert abs(row["alone_magnitude"] - 1) < 1e-4
        assert abs(row["alone_location"] - 1) < 1e-4
        assert row["joint_magnitude"] > 1e3
    for name in ("magnitude", "location"):
        for place, row in tip[f"{name}_tip"].items():
            values = list(row.values())
            assert values == sorted(values), (name, place)
            assert all(many < one for many, one in zip(tip[f"{name}_points"][place].values(), values, strict=True))
        assert tip[f"{name}_tip"]["0.95"]["8"] > 2


def test_beam_sensitivities_are_those_of_the_deflection():
    """The closed forms (c), (d) against w itself, by differences."""
    EI, s = 0.04, torch.linspace(0, L, 4001)

    def w(F, a):
        near = F * s**2 * (3 * a - s) / (6 * EI)
        return torch.where(s <= a, near, F * a**2 * (3 * s - a) / (6 * EI))

    def rms(y):
        return (torch.trapezoid(y * y, s) / L).sqrt()

    F, h = 0.7, 1e-6
    for a in (0.05, 0.2, 0.39):
        by_force, by_place = sensitivity.beam(EI, T(F), T(a))
        assert abs(1e-3 / rms(w(1.0, a)) / by_force - 1) < 1e-5
        assert abs(1e-3 / rms((w(F, a + h) - w(F, a - h)) / (2 * h)) / by_place - 1) < 1e-4


def test_jacobian_is_that_of_the_forward_solve():
    F, a, h = T([0.3, 4.0]), T([0.15, 0.33]), 1e-5
    J = sensitivity.jacobian(steel_rod(), F, a)

    def points(F, a):
        load = PointForces(torch.nn.functional.pad(F[:, None, None], (0, 2)), a.unsqueeze(-1))
        return solve_shape(steel_rod(), (load,), None, sensitivity.S, 2, 80).p.flatten(1) / sensitivity.POINTS**0.5

    for k, difference in enumerate((points(F + h, a) - points(F - h, a), points(F, a + h) - points(F, a - h))):
        assert (J[..., k] - difference / (2 * h)).norm() < 1e-4 * J[..., k].norm()


@pytest.mark.study
def test_sensitivities(three):
    data = three[1]
    assert data["small_force_off"] < 0.01
    for place, row in data["magnitude_factor_base"].items():
        values = list(row.values())
        assert values == sorted(values), f"rises with force at {place} m"
        assert values[-1] > 2
    for place in ("0.1", "0.2"):
        values = list(data["magnitude_factor_section"][place].values())
        assert values == sorted(values), "rises until the tip points backwards"
    for frame in ("section", "base"):
        assert data[f"joint_factor_{frame}"]["0.2"]["0.1"] > 10
        for place, row in data[f"joint_factor_{frame}"].items():
            for force, factor in row.items():
                assert factor > 1
                assert abs(data[f"joint_location_factor_{frame}"][place][force] / factor - 1) < 1e-6
    units = data["units"]
    assert units["rows_off"] < 1e-9
    assert units["norm_N_mm"] > 10 * units["norm_N_m"]
    assert units["minimum_norm_N_mm_force_N"] > 10 * units["minimum_norm_N_m_force_N"]


def test_joint_sensitivity_is_the_row_norm_of_the_pseudo_inverse():
    J = sensitivity.jacobian(steel_rod(), T([1.0]), T([0.2]))
    rows = 1e-3 * torch.linalg.pinv(J).norm(dim=-1)
    assert (sensitivity.jointly(J) / rows - 1).abs().max() < 1e-9


@pytest.mark.study
def test_innovation_and_index(wrong):
    data = wrong[1]
    for part in ("innovation_linear", "innovation_paper", "innovation_scaled"):
        good, bad = data[part]["z - h"], data[part]["h - z"]
        assert good[-1] < 1e-2 * good[0], part
        assert bad[1] > 1.5 * bad[0], part
        assert bad[-1] is None or bad[-1] > 4 * bad[0], part
    right, *others = data["index"].values()
    assert right < 1e-12
    assert min(others) > 1e-2


@pytest.mark.study
def test_damping_and_actuation(wrong):
    data = wrong[1]
    rows = list(data["damping"].values())
    for small, large in itertools.pairwise(rows):
        assert large["step"] > small["step"]
    assert rows[0]["iterations"] > 3 * rows[-1]["iterations"]
    assert list(data["contraction"].values()) == sorted(data["contraction"].values(), reverse=True)
    for a in data["actuation"].values():
        assert a["solved"] == 1
        assert abs(a["bend_solved_rad"] / a["bend_rad"] - 1) < 1e-4
        assert abs(a["pulled_solved_m"] / a["pulled_m"] - 1) < 1e-3
    assert abs(data["actuation"]["cm"]["bend_rad"] - 16.4) < 0.1


@pytest.mark.study
def test_counts_tip_and_sensitivity(wrong):
    data = wrong[1]
    assert data["counts"] == {"three_gaussians": 12, "gaussians_k_0_to_3": 16}
    tip = data["over_the_tip"]
    assert abs(tip["0"]["net_force_N"] / tip["0"]["force_N"] - 2) < 1e-4
    assert all(abs(row["base_N"] / row["force_N"] - 1) < 1e-4 for row in tip.values())
    for row in data["sensitivity"].values():
        assert abs(row["alone_magnitude"] - 1) < 0.01
        assert abs(row["alone_location"] - 1) < 0.01
        assert row["joint_magnitude"] > 10
    assert data["points"]["discs"] == 9
    assert abs(data["points"]["location_std_nine_m"] / data["points"]["location_std_eight_m"] - 1) < 1e-9


@pytest.mark.study
def test_the_means_of_the_printed_rows(wrong):
    """As PAPER's rows have them, and not as its text says of Tables I and II."""
    for table, (force, location) in {"I": (0.32, 1.98), "II": (0.61, 4.19), "III": (0.65, 3.98)}.items():
        found = wrong[1]["means"][table]
        assert abs(found[0] - force) < 0.0051
        assert abs(100 * found[1] - location) < 0.0051


def test_the_page_has_every_erratum():
    page = (ROOT / "docs" / "errata.md").read_text()
    for words in ("(3), (4)", "the index", "(5)", "damping", "actuation", "means", "(10)", "(13)", "(7), (8)", "Eight points"):
        assert any(words in line for line in page.splitlines() if line.startswith("## ")), words
    assert page.count("\n## ") == 10
    assert "(12): " not in page
