"""scripts/compare.py tells records that agree from records that do not. No checkout is run here."""

import copy

import compare
import numpy as np
import pytest

RECORD = {
    "results": [
        {
            "status": "converged",
            "accepted": True,
            "iterations": 7,
            "chi2": 51.0,
            "loads": [
                {
                    "force_local_N": [0.6, -0.3],
                    "magnitude_N": 0.67,
                    "location_m": 0.25,
                    "width_m": 0.004,
                    "std": {"magnitude_N": 0.02, "location_m": 0.003},
                    "interval_95": {"magnitude_N": [0.63, 0.71], "location_m": [0.244, 0.256]},
                }
            ],
            "base_wrench": {"force_N": [0.6, -0.3, 0.0], "moment_Nm": [0.1, 0.1, 0.0]},
        }
    ]
}


def difference(change, loose: bool = False) -> compare.Difference:
    """Of the record and the record changed."""
    other = copy.deepcopy(RECORD)
    change(other["results"][0])
    return compare.compared(compare.Case("a case", "", {}, loose=loose), RECORD, other)


def put(*path: str | int, value):
    """A change of one entry."""

    def change(record):
        for key in path[:-1]:
            record = record[key]
        record[path[-1]] = value

    return change


def test_the_same_record_agrees():
    found = difference(lambda record: None)
    assert set(found.relative.values()) == {0.0} and found.in_std == 0.0
    assert not found.failure(0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "kind", "size"),
    [
        (put("loads", 0, "force_local_N", 0, value=0.6 * (1 + 1e-6)), "force", 1e-6 * 0.6 / np.hypot(0.6, 0.3)),
        (put("loads", 0, "location_m", value=0.25 * (1 - 1e-6)), "location", 1e-6),
        (put("loads", 0, "width_m", value=0.004 * (1 + 1e-6)), "width", 1e-6),
        (put("loads", 0, "std", "location_m", value=0.003 * (1 + 1e-6)), "intervals", 1e-6),
        (put("loads", 0, "interval_95", "magnitude_N", value=[0.63, 0.71 + 1e-6]), "intervals", 1e-6 / np.hypot(0.63, 0.71)),
        (put("base_wrench", "moment_Nm", value=[0.1, 0.1, 1e-6]), "base wrench", 1e-6 / np.hypot(0.1, 0.1)),
        (put("chi2", value=51.0 * (1 + 1e-6)), "chi2", 1e-6),
    ],
)
def test_every_kind_of_number_is_compared(change, kind, size):
    found = difference(change)
    assert found.relative.pop(kind) == pytest.approx(size, rel=1e-6)
    assert not any(found.relative.values())
    found.relative[kind] = size
    assert found.failure(0.9 * size, 0.0) and not found.failure(1.1 * size, 0.0)


@pytest.mark.parametrize(
    "change",
    [
        put("status", value="not_converged"),
        put("accepted", value=False),
        put("loads", value=[]),
        put("loads", 0, "std", "location_m", value=None),
        put("noise", value={"noise_m": 1e-3}),
    ],
)
def test_another_story_is_never_in_agreement(change):
    assert difference(change).failure(1.0, 1.0)
    assert difference(change, loose=True).failure(1.0, 1.0)


def test_a_loose_case_is_judged_in_standard_deviations():
    found = difference(put("loads", 0, "location_m", value=0.25 + 3e-6), loose=True)
    assert found.in_std == pytest.approx(1e-3)
    assert found.failure(1.0, 0.9e-3) and not found.failure(0.0, 1.1e-3)


def test_iterations_are_told_and_not_judged():
    found = difference(put("iterations", value=8))
    assert found.differ["iterations"] == 1 and not found.failure(0.0, 0.0)
    assert "| 0 | 0 | 1 | agrees |" in compare.table([found], 1e-9, 1e-3)[-1]
