"""Tables as data frames, with curves and correlations of their columns.

Shapes: N rows, D design, R runs, X points of a curve.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from coim.tables import DESIGN_PREFIX, Layout, read_table

DTYPES = {str: "object", int: "int64", float: "float64"}


def read_frame(path: Path, layout: Layout) -> pd.DataFrame:
    """Read a CSV file whose every cell is checked.

    Args:
        path: of the file; one that does not exist is read as an empty one.
        layout: of the file.

    Returns:
        A row for each line, with all columns of the layout, and those that the file has besides. Missing numbers are
        NaN, missing texts empty.

    Raises:
        ValueError: if it is not such a file; see `coim.tables.read_table`.
    """
    table = read_table(path, layout)
    return pd.DataFrame({name: pd.Series(cells, dtype=DTYPES[layout.type_of(name)]) for name, cells in table.items()})


def rows_of(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table, one by one, each cell under the name of its column.

    Example:
        >>> rows_of(pd.DataFrame({"run": [0, 1], "kind": ["first", "random"]}))
        [{'run': 0, 'kind': 'first'}, {'run': 1, 'kind': 'random'}]
    """
    return [{str(name): cell for name, cell in row.items()} for row in table.to_dict("records")]


def design_columns_of(rows: pd.DataFrame) -> list[str]:
    """Columns that hold the D entries of a design."""
    return [name for name in rows.columns if name.startswith(DESIGN_PREFIX)]


def designs_of(rows: pd.DataFrame) -> np.ndarray:
    """Designs of N rows, ``[N, D]``."""
    return rows[design_columns_of(rows)].to_numpy(dtype=float)


def at(rows: pd.DataFrame, place: tuple[str, str], arm: str | None = None) -> pd.DataFrame:
    """Rows of one environment and task, of one arm or of all."""
    here = (rows["environment"] == place[0]) & (rows["task"] == place[1])
    return rows[here & (rows["arm"] == arm)] if arm is not None else rows[here]


@dataclass(frozen=True)
class Curves:
    """One number of R runs over the same points.

    Attributes:
        x: ``[X]``, rising.
        y: ``[R, X]``, NaN where a run has no number.
    """

    x: np.ndarray
    y: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Mean over the runs that have a number, ``[X]``."""
        known = np.isfinite(self.y)
        count = known.sum(0)
        total = np.where(known, self.y, 0.0).sum(0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def averaged(self, block: int) -> Curves:
        """Means of ``block`` neighbouring points each; the last has what is left."""
        starts = np.arange(0, self.x.size, block)
        if block == 1 or not starts.size:
            return self
        known = np.isfinite(self.y)
        count = np.add.reduceat(known.astype(int), starts, axis=1)
        total = np.add.reduceat(np.where(known, self.y, 0.0), starts, axis=1)
        width = np.diff(starts, append=self.x.size)
        y = np.where(count > 0, total / np.maximum(count, 1), np.nan)
        return Curves(np.add.reduceat(self.x, starts) / width, y)

    @property
    def shared(self) -> Curves:
        """The points at which every run that has got so far has a number.

        Elsewhere a mean would be over other runs than beside it, and jump from one to the other.
        """
        known = np.isfinite(self.y)
        beyond = np.flip(np.cumsum(np.flip(known, 1), 1), 1) == 0  # no number from here on: it is over, or under way
        there = (known | beyond).all(0)
        return Curves(self.x[there], self.y[:, there])


def curves(rows: pd.DataFrame, x: str, y: str, *, runs: Sequence[str] = ("run",)) -> Curves:
    """One column over another, a curve for each run.

    Args:
        rows: of any number of runs.
        x: column of the points.
        y: column of the values; one that does not exist has no points.
        runs: columns that name a run.

    Returns:
        The curves in the order of these columns, at the points at which any run has a finite number.

    Example:
        >>> rows = pd.DataFrame({"run": [0, 0, 1], "step": [1, 2, 2], "error": [0.5, 0.25, 0.75]})
        >>> curves(rows, "step", "error").y.tolist()
        [[0.5, 0.25], [nan, 0.75]]
    """
    wanted = rows.reindex(columns=[*runs, x, y]).drop_duplicates([*runs, x], keep="last")
    values = wanted.pivot(index=[*runs], columns=x, values=y).astype(float)
    values = values.where(np.isfinite(values)).dropna(axis="columns", how="all")
    return Curves(values.columns.to_numpy(dtype=float), values.to_numpy())


def spearman(x: ArrayLike, y: ArrayLike) -> float:
    """Spearman's rank correlation; NaN for less than three values, or where all values of one side are equal.

    Example:
        >>> spearman([1.0, 2.0, 3.0], [10.0, 30.0, 20.0])
        0.5
    """
    one, other = pd.Series(np.asarray(x)), pd.Series(np.asarray(y))
    if min(one.nunique(), other.nunique()) < 2:
        return float("nan")
    return float(one.corr(other, method="spearman", min_periods=3))


def spearman_given(x: ArrayLike, y: ArrayLike, *, given: ArrayLike) -> float:
    """Partial rank correlation with a third variable held fixed.

    NaN for less than four values, or where the third variable determines one of the others.
    """
    x_y, x_z, y_z = spearman(x, y), spearman(x, given), spearman(y, given)
    rest = (1 - x_z**2) * (1 - y_z**2)
    return (x_y - x_z * y_z) / math.sqrt(rest) if len(np.asarray(x)) > 3 and rest > 1e-12 else math.nan
