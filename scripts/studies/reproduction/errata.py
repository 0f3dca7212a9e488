"""docs/errata.md: what is wrong in the paper as printed, what is right, and the computation that shows it."""

import math
import textwrap
from pathlib import Path
from typing import Any

import torch

from . import errata_shown as shown
from .cases import steel_rod, study1
from .sensitivity import PLACES, alone, beam, jacobian, jointly
from .sinusoids import clamped, clamped_closed, rigid_section, supported, supported_closed

HEAD = """# Errata of the paper

Made by `python scripts/reproduce.py errata`; every number here is computed when the command runs, except where it says so. V. Aloi
and D. C. Rucker, "Estimating Forces Along Continuum Robots", IEEE RA-L 2022. The paper itself is not in this repository: "printed"
is how we read it, and where a reading had to be chosen the section says which.
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
        "contraction": shown.contraction(),
        "actuation": shown.actuation(),
        "counts": shown.counts(),
        "over_the_tip": shown.over_the_tip(),
        "sensitivity": _sensitivity(),
    }
    sections = (_innovation, _index, _deflection, _damping, _actuation, _tables, _sums, _beyond, _joint)
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
    rows = {"printed": supported_closed(1.0, n), "with_EI": supported_closed(EI, n), "supported": supported(robot, n)}
    rows |= {"clamped": clamped(robot, n), "clamped_closed": clamped_closed(EI, n)}
    return {"EI_Nm2": EI} | {f"{k}_n_{m}": float(v[i]) for k, v in rows.items() for i, m in enumerate((1, 10))}


def _sensitivity() -> dict[str, dict[str, float]]:
    """At 1 mN: the Jacobian's sensitivities over Euler-Bernoulli's, magnitude and location, one at a time and jointly."""
    robot, a = steel_rod(), torch.tensor(PLACES, dtype=torch.float64)
    F = torch.full_like(a, 1e-3)
    J = jacobian(robot, F, a)
    straight = torch.stack(beam(robot.rod.bending_stiffness, F, a), -1)
    one, both = alone(J) / straight, jointly(J) / straight
    keys = ("alone_magnitude", "alone_location", "joint_magnitude", "joint_location")
    return {f"{x:g}": dict(zip(keys, [*one[i].tolist(), *both[i].tolist()], strict=True)) for i, x in enumerate(PLACES)}


def _innovation(d: dict[str, Any]) -> list[str]:
    return [
        "(3), (4): the sign of the innovation",
        "Printed: the innovation of (4) is z~ = h(x) - z, the residual of (3), and x+ = x + K z~. Right: x+ = x + K (z - h(x)). "
        "In (3) the sign is squared away; in (4) it decides. For z = H x the error obeys e+ = (I - K H) e with the right sign and "
        "e+ = (I + K H) e with the printed one; the eigenvalues of I + K H lie between 1 and 2.",
        "Linear problem, 8 data, 3 unknowns, Sigma_0 = Q = I: distance of x from the truth by iteration.",
        _by_iteration("innovation", d["innovation_linear"]),
        "One case of Study 1 without noise, the paper's coordinates and plain recursion: root mean square distance (mm) of the "
        "markers from the model by iteration. The printed sign doubles it, then makes the width parameter c negative, and there is "
        "no shape any more.",
        _by_iteration("innovation", d["innovation_paper"]),
        "The same case in our coordinates, where c cannot become negative and no step exceeds 0.6: the printed sign walks away.",
        _by_iteration("innovation", d["innovation_scaled"]),
    ]


def _index(d: dict[str, Any]) -> list[str]:
    return [
        "(4): the indices of Sigma-bar",
        "Printed: (4) does not give the predicted covariance Sigma_bar = Sigma + Q one index throughout. Right: one prediction per "
        "step, and gain and covariance update both take it, K = Sigma_bar H^T (H Sigma_bar H^T + R)^-1 and Sigma+ = (I - K H) "
        "Sigma_bar. All have the same size, so dimensions do not tell; the index does: a Sigma_bar of the step before is not "
        "defined at the first step, and it leaves out what the last datum has taught.",
        "Eight scalar data one after the other, three unknowns at rest (Q = 0), prior 0 +- 1: the filter must end at the batch "
        "least-squares answer. We do not choose which mixture is meant: every one fails (the prior stands in for the first).",
        _table(["Sigma_bar taken", "distance from batch least squares"], [[k, f"{v:.1e}"] for k, v in d["index"].items()]),
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
        "Printed: the RMS deflection under A sin(n pi s / L) without EI in the denominator, A L^4 / (sqrt(2) n^4 pi^4). Right: "
        "A L^4 / (sqrt(2) EI n^4 pi^4), and for simply supported ends only. Printed, it is no length: A L^4 is in N m^3, and for "
        f"this rod (EI = {s['EI_Nm2']:.5f} N m^2) its number is {over:.5f} of the solver's deflection in metres: the factor is EI.",
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
        "Little damping is not always good: without step limit and adaptive noise a large Q overshoots, as Gauss-Newton does. "
        "Measured once, not when this command runs, on the same 20 cases, at most 500 iterations: 26, 38 and 106 iterations "
        "with Q = 0.01, 1 and 100; 20, 19 and 16 cases converged.",
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
    rows = [
        ["I", "location 2.7 cm", "0.32 N / 1.98 cm"],
        ["II", "0.51 N / 2.64 cm", "0.61 N / 4.19 cm"],
        ["III", "0.65 N / 3.98 cm", "0.65 N / 3.98 cm (as printed)"],
    ]
    return [
        "Tables I-III: the means in the text",
        "NOT recomputed here: the rows of the tables are not in this repository. Quoted from the project's notes, made from the "
        "printed rows before the project was started:",
        _table(["table", "mean errors in the text", "mean of the printed rows"], rows),
    ]


def _sums(d: dict[str, Any]) -> list[str]:
    n = d["counts"]
    return [
        "(10), (12): where the sums begin",
        "Printed: (10) sums the Gaussians from k = 0, (12) the Fourier terms from k = 1. Right: Gaussians are counted 1..K, and "
        f"the series needs its constant, k = 0. Three Gaussians have {n['three_gaussians']} parameters; k = 0..3 would be "
        f"{n['gaussians_k_0_to_3']}. The series with three periods, in x and y, has {n['size']} (`FourierCoordinates(3).size`):",
        _table(
            ["sums", "parameters", "independent"],
            [
                ["cosine 0..3, sine 1..3 (right)", str(n["cosine_from_0"]), str(n["cosine_from_0_rank"])],
                ["both 0..3", str(n["both_from_0"]), f"{n['both_from_0_rank']} (sin 0 is nothing)"],
                ["both 1..3 (printed)", str(n["both_from_1"]), "no net force"],
            ],
        ),
        f"Without the constant, {100 * n['uniform_missed_without_constant']:.0f} % of a uniform load is missed: every term has "
        "mean zero.",
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
            f"{1e3 * float(a):.0f}",
            *(f"{r[k]:.4f}" for k in ("alone_magnitude", "alone_location")),
            *(f"{r[k]:.1f}" for k in ("joint_magnitude", "joint_location")),
        ]
        for a, r in d["sensitivity"].items()
    ]
    head = ["a (mm)", "magnitude alone", "location alone", "magnitude, both unknown", "location, both unknown"]
    return [
        "(7), (8): they agree one parameter at a time only",
        "Printed: (8), the pseudo-inverse of the Cosserat Jacobian, generalizes the sensitivities (7) of the beam. Right: one "
        "column at a time it does. With F and a both unknown it answers another question (the other not known), and its norm as a "
        "whole mixes units. The joint answer is the square root of the diagonal of (J^T J)^-1, the norms of its rows.",
        "At 1 mN, where the rod is straight: the Cosserat sensitivity over (7).",
        _table(head, rows),
        "Over the force, and what exactly depends on units: figures 3 and 4, [reproduction.md](reproduction.md).",
    ]
