"""docs/errata.md: what is wrong in the paper as printed, what is right, and the computation that shows it."""

import math
import textwrap
from pathlib import Path
from typing import Any

import torch

from . import errata_shown as shown
from .cases import steel_rod, study1
from .sensitivity import jacobian, unit_check
from .sinusoids import clamped, clamped_closed, rigid_section, supported, supported_closed
from .tables import ABOUT, TEXT, paper_means
from .tip_sensitivity import tip_figures

HEAD = """# Errata of the paper

Made by `python scripts/reproduce.py errata`; every number here is computed when the command runs, except where it says so. V. Aloi
and D. C. Rucker, "Estimating Forces Along Continuum Robots", IEEE RA-L 2022.
"""


def run(quick: bool, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Every erratum; writes FOLDER/errata.md, and gives the page of the studies a pointer to it."""
    study = study1(20)
    data = {
        "innovation_linear": shown.linear_innovation(),
        "innovation_paper": shown.shape_innovation(study, True, 12),
        "innovation_scaled": shown.shape_innovation(study, False, 6),
        "index": shown.index_choices(),
        "sinusoids": _sinusoids(),
        "damping": shown.damping(study, (1e-3, 1e-2, 1.0, 100.0), 4 if quick else 20),
        "plain": shown.undamped(study, (1e-2, 1.0, 100.0)),
        "contraction": shown.contraction(),
        "actuation": shown.actuation(),
        "counts": shown.counts(),
        "over_the_tip": shown.over_the_tip(),
        "sensitivity": tip_figures()["at_1_mN"],
        "units": unit_check(jacobian(steel_rod(), torch.ones(1).double(), torch.full((1,), 0.2).double())[0]),
        "means": {table: list(paper_means(table)) for table in ABOUT},
        "points": shown.points(),
    }
    sections = (_innovation, _index, _deflection, _damping, _actuation, _tables, _sums, _beyond, _joint, _points)
    page = [HEAD]
    for section in sections:
        title, *blocks = section(data)
        page += [f"## {title}\n", *(_filled(block) + "\n" for block in blocks)]
    (folder / "errata.md").write_text("\n".join(page), encoding="utf-8")
    return data, [
        "## Errata",
        "",
        f"{len(sections)} errata of the paper, each with the computation that shows it: [errata.md](errata.md).",
        "",
    ]


def _filled(block: str) -> str:
    """A paragraph at the page's width; tables as they are."""
    return block if block.startswith("|") else textwrap.fill(block, 120, break_long_words=False, break_on_hyphens=False)


def _table(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows))


def _by_iteration(first: str, rows: dict[str, list[float | None]]) -> str:
    """A row for each sign, a column for each iteration."""
    count = len(next(iter(rows.values())))
    cells = [[name, *("no shape" if v is None else f"{v:.3g}" for v in values)] for name, values in rows.items()]
    return _table([first, *(str(k) for k in range(count))], cells)


def _sinusoids() -> dict[str, float]:
    """(5) against the solver at n = 1 and 10, both supports (m per N/m)."""
    n, robot = torch.tensor([1, 10]), rigid_section(steel_rod())
    EI = robot.rod.bending_stiffness
    rows = {"printed": supported_closed(1 / EI, n), "with_EI": supported_closed(EI, n), "supported": supported(robot, n)}
    rows |= {"clamped": clamped(robot, n), "clamped_closed": clamped_closed(EI, n)}
    return {"EI_Nm2": EI} | {f"{k}_n_{m}": float(v[i]) for k, v in rows.items() for i, m in enumerate((1, 10))}


def _innovation(d: dict[str, Any]) -> list[str]:
    return [
        "(3), (4): the sign of the innovation",
        "Printed: the residual of (3) is model minus measurement, z~ = h(x) - z, and (4) adds K z~. Right: x+ = x + K (z - h(x)). "
        "In (3) the sign is squared away; in (4) it decides. For z = H x the error obeys e+ = (I - K H) e with the right sign and "
        "e+ = (I + K H) e with the printed one; the eigenvalues of I + K H lie between 1 and 2.",
        "Linear problem, 8 data, 3 unknowns, Sigma_0 = Q = I: distance of x from the truth by iteration.",
        _by_iteration("innovation", d["innovation_linear"]),
        "One case of Study 1 without noise, the paper's coordinates and plain recursion: root mean square distance (mm) of the "
        "markers from the model by iteration. The printed sign doubles it and walks away, until there is no shape any more.",
        _by_iteration("innovation", d["innovation_paper"]),
        "The same case in our coordinates, where c cannot become negative and no step exceeds 0.6: the printed sign walks away.",
        _by_iteration("innovation", d["innovation_scaled"]),
    ]


def _index(d: dict[str, Any]) -> list[str]:
    return [
        "(4): the index of Sigma-bar",
        "Printed: K_i = Sigma_bar_(i-1) H^T (H Sigma_bar_i H^T + W^-1)^-1. Right: Sigma_bar_i in front, too. Dimensions do not "
        "tell; "
        "but the Sigma_bar of the step before leaves out what the last datum has taught, and at the first step there is none.",
        "Eight scalar data one after the other, three unknowns at rest (Q = 0), prior 0 +- 1: the filter must end at the batch "
        "least-squares answer.",
        _table(["Sigma_bar in the gain", "distance from batch least squares"], [[k, f"{v:.1e}"] for k, v in d["index"].items()]),
    ]


def _deflection(d: dict[str, Any]) -> list[str]:
    s = d["sinusoids"]
    over = s["printed_n_1"] / s["supported_n_1"]
    rows = [
        [name, *(f"{1e3 * s[f'{key}_n_{n}']:.5g}" for n in (1, 10))]
        for name, key in (
            ("(5) with EI in the denominator (mm)", "with_EI"),
            ("Cosserat solver, simply supported (mm)", "supported"),
            ("Cosserat solver, cantilever (mm)", "clamped"),
            ("closed form, cantilever (mm)", "clamped_closed"),
        )
    ]
    return [
        "(5): EI, and the supports",
        "Printed: f(s) = A sin(omega s) = (1/EI) d^4 delta / ds^4 and RMS = sqrt(2) A EI / (2 omega^4). Right: f = EI d^4 delta / "
        "ds^4 and RMS = sqrt(2) A / (2 EI omega^4), and for simply supported ends only. Printed, a stiffer rod would bend further; "
        f"for the rod of the studies (EI = {s['EI_Nm2']:.5f} N m^2) the printed number is {over:.6f} of the solver's "
        "deflection: the "
        f"factor is EI^2 = {s['EI_Nm2'] ** 2:.6f}. Figure 2 has EI = 1 N m^2, where it does not show.",
        "RMS deflection of the rod of the studies per N/m, by the solver and by the formulas:",
        _table(["", "n = 1", "n = 10"], rows),
        "On simple supports it falls like 1/n^4, on a cantilever, as the robot is, like 1/n: its clamp carries the "
        "load's moment (figure 2, [reproduction.md](reproduction.md)).",
    ]


def _damping(d: dict[str, Any]) -> list[str]:
    rows = [[Q, f"{r['step']:.3f}", f"{r['iterations']:.1f}", f"{100 * r['converged']:.0f} %"] for Q, r in d["damping"].items()]
    c = d["contraction"]
    return [
        "What Q does: damping is reversed",
        "Printed: a larger Q increases damping. Right: it lessens it. With Lambda = (Sigma + Q)^-1 + H^T W H the step is Lambda^-1 "
        "H^T W (z - h): (Sigma + Q)^-1 stands where Levenberg and Marquardt have their damping, so a larger Q means longer steps. "
        "Without Q, Sigma shrinks at every iteration, and so do the steps.",
        "Study 1 without noise, our default settings (step limit, adaptive noise): length of the first full step from "
        "one start (Sigma_0 = 0), and iterations to converge "
        "(Sigma_0 = I, at most 200, no restarts).",
        _table(["Q", "first step", "iterations", "converged"], rows),
        "One linear unknown with unit information, Sigma_0 = 1: error left after 20 iterations "
        + "; ".join(f"Q = {Q}: {left:.1e}" for Q, left in c.items())
        + ".",
        "Little damping is not always good: without step limit and adaptive noise a large Q overshoots, as Gauss-Newton does. The "
        "same cases so, at most 500 iterations:",
        _table(
            ["Q", "iterations of those that converged", "converged"],
            [[Q, f"{r['iterations']:.1f}", f"{100 * r['converged']:.0f} %"] for Q, r in d["plain"].items()],
        ),
    ]


def _actuation(d: dict[str, Any]) -> list[str]:
    rows = [
        [
            f"11.5 {unit}",
            f"{a['bend_rad']:.2f} rad, {a['bend_rad'] / math.tau:.2f} turns",
            f"{a['bend_solved_rad']:.2f} rad",
            f"{1e3 * a['pulled_solved_m']:.2f} mm",
            f"{a['tension_N']:.1f} N",
            f"{a['stress_Pa'] / 1e9:.2f} GPa",
        ]
        for unit, a in d["actuation"].items()
    ]
    return [
        "Tables I-III: the unit of the actuation",
        "Printed: actuation in cm, up to 11.5. Right: only mm is possible. Pulling x of a tendon at the offset r = 7 mm bends the "
        "rod by x / r, and takes the tension x EI / (r^2 L).",
        "One-tendon robot of `tests/data/shape_reference.json` (L = 0.4 m, d = 1.4 mm, offset 7 mm), without gravity, under that "
        "tension tau; the forward solve bends by tau r L / EI and shortens its tendon by what was pulled:",
        _table(["pulled", "x / r", "forward solve bends", "shortens by", "tension", "stress of the outer fibre"], rows),
        "In cm the rod would be wound up two and a half times under a stress that no spring steel bears.",
    ]


def _tables(d: dict[str, Any]) -> list[str]:
    rows = []
    for table, (force, location) in d["means"].items():
        said = f"{TEXT[table][0]:g} N / {100 * TEXT[table][1]:.2f} cm"
        rows.append([table, said, f"{force:.3f} N / {100 * location:.2f} cm"])
    return [
        "Tables I and II: the means in the text",
        "The text says 2.7 cm for Table I, 0.51 N and 2.64 cm for Table II. The means of |estimated - measured| over "
        "the printed "
        "rows (`scripts/studies/reproduction/tables.csv`) are other ones; those of Table III agree.",
        _table(["table", "mean errors in the text", "mean of the printed rows"], rows),
    ]


def _sums(d: dict[str, Any]) -> list[str]:
    n = d["counts"]
    return [
        "(10): where the sum begins",
        "Printed: (10) sums the Gaussians from k = 0. Right: from k = 1, as (12) counts their parameters: three Gaussians have "
        f"{n['three_gaussians']} (`PaperCoordinates(3).size`), as the paper says; k = 0 to 3 would be four of them, with "
        f"{n['gaussians_k_0_to_3']}.",
    ]


def _points(d: dict[str, Any]) -> list[str]:
    p = d["points"]
    return [
        "Eight points against nine markers",
        "The introduction of section III says eight points; the one-tendon robot has markers on its discs, N_p = 9. Both can "
        "be meant: "
        f"{p['discs']:.0f} discs 5 cm apart end at {100 * p['length_m']:.0f} cm, the whole length, if one of them is at the base, "
        "and a marker there does not move. "
        f"The bound of the location of a push at {1e3 * p['location_m']:.0f} mm is {1e3 * p['location_std_nine_m']:.3f} mm with "
        "nine "
        f"points and {1e3 * p['location_std_eight_m']:.3f} mm with the eight off the base (rod of the studies, 1 mm noise).",
    ]


def _beyond(d: dict[str, Any]) -> list[str]:
    rows = [
        [
            f"{k} sigma",
            f"{r['net_force_N']:.4f}",
            f"{r['force_N']:.4f}",
            f"{r['base_N']:.4f}",
            f"{r['net_force_N'] / r['force_N']:.3f}",
        ]
        for k, r in d["over_the_tip"].items()
    ]
    return [
        "(13): what hangs over the tip",
        "Printed: the net force of a Gaussian is a sqrt(pi / c), its integral over all s. Right: only the part on the rod acts, "
        "that times (erf(sqrt(c) (L - mu)) + erf(sqrt(c) mu)) / 2. At the tip half of it is missing, a factor of 2.",
        "`GaussianCoordinates.describe` gives both, `force` (on the rod) and `net_force` (13), as `Estimate` does. A Gaussian of "
        "sigma = 10 mm and 0.1 N on the rod, by its distance from the tip, and the force the forward solve finds at the clamp:",
        _table(["centre before the tip", "(13), N", "on the rod, N", "at the clamp, N", "(13) / on the rod"], rows),
    ]


def _joint(d: dict[str, Any]) -> list[str]:
    rows = [
        [
            a,
            *(f"{r[k]:.5f}" for k in ("alone_magnitude", "alone_location")),
            *(f"{r[k]:.2g}" for k in ("joint_magnitude", "joint_location")),
        ]
        for a, r in d["sensitivity"].items()
    ]
    head = ["mu (m)", "magnitude alone", "location alone", "magnitude, both columns", "location, both columns"]
    u = d["units"]
    return [
        "(7), (8): they agree one parameter at a time only",
        "Printed: (8), with the pseudo-inverse for F and mu together, agrees with (7) while the rod is straight. Right: one "
        "column of J = H12 - H11 H21^+ H22 at a time it does. The pseudo-inverse of both columns answers another question, and "
        "where "
        "there are fewer measurements than parameters it mixes their units.",
        "L = 1 m, EI = 1 N m^2, position of the tip, F = 1 mN, where the rod is straight: (8) over (7).",
        _table(head, rows),
        "The units, on the rod of the studies, 1 N at 200 mm, lateral deflection of the tip alone: the minimum-norm answer to "
        "1 mm is "
        f"{1e3 * u['minimum_norm_N_m_force_N']:.2f} mN and {1e3 * u['minimum_norm_N_m_location_m']:.2f} mm in (N, m), "
        f"{1e3 * u['minimum_norm_N_mm_force_N']:.2f} mN and {1e3 * u['minimum_norm_N_mm_location_m']:.5f} mm in (N, mm).",
        "Over the force, and with more points: figures 3 and 4, [reproduction.md](reproduction.md).",
    ]
