"""What a fleet's table holds of a diagnosis, and of a log that could not be used."""

from collections.abc import Sequence
from typing import Any

import pandas as pd

from ..diagnosis import Diagnosis

Row = dict[str, Any]

# A row per log and finding, one without a finding where nothing is named; in the order of the file's columns.
COLUMNS = {
    "name": "string",
    "craft": "string",
    "date": "datetime64[us]",
    "kind": "string",
    "vehicle": "string",
    "train": "string",
    "test": "string",
    "verdict": "string",
    "effect": "string",
    "target": "string",
    "since": "float64",
    "since_log": "string",
    "parameters": "object",
    "sizes": "object",
    "std": "object",
    "units": "object",
    "nats": "float64",
    "gain": "float64",
    "gain_low": "float64",
    "gain_high": "float64",
    "held_out": "boolean",
    "report": "string",
    "error": "string",
}


def rows_of(diagnosis: Diagnosis) -> list[Row]:
    """What a diagnosis says, a row per finding."""
    gain = diagnosis.gain
    low, high = gain.ratio_ci95 or (None, None)
    whole = {
        "kind": diagnosis.vehicle.name,
        "verdict": diagnosis.verdict,
        "gain": gain.ratio,
        "gain_low": low,
        "gain_high": high,
        "held_out": gain.held_out,
    }
    findings = [
        {
            "effect": one.effect,
            "target": one.target,
            "since": one.since,
            "since_log": one.since_log,
            "parameters": list(one.parameters),
            "sizes": [p.value for p in one.parameters.values()],
            "std": [p.std for p in one.parameters.values()],
            "units": [p.unit for p in one.parameters.values()],
            "nats": one.log_evidence,
        }
        for one in diagnosis.findings
    ]
    return [whole | finding for finding in findings or [{}]]


def frame_of(rows: Sequence[Row]) -> pd.DataFrame:
    """The rows as a table, whose columns have their types also where all are empty."""
    return pd.DataFrame(
        {name: pd.Series([row.get(name) for row in rows], dtype=kind) for name, kind in COLUMNS.items()}
    )
