"""The study of map sizes as a plot: held-out error over size, a line for each way regions hang together."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from viz.colours import BLUE, SKY_BLUE, VERMILLION, hex_of

KINDS = {(1.0, None): ("blended", BLUE), (0.0, 0): ("hard, narrow neighbourhood", SKY_BLUE),
         (0.0, 1): ("hard, wide neighbourhood", VERMILLION)}  # fmt: skip


def save_topology(studies: Mapping[str, NDArray[np.float64]], path: Path) -> None:
    """Write the plot of ``studies`` (by relation, rows of :meth:`stages.topology.Study.to_arrays`) to a
    ``.png`` or ``.svg`` file; the chosen size is ringed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.5 * len(studies), 3.5), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(studies)))
    for axis, (name, rows) in zip(axes, studies.items(), strict=True):
        widths = sorted({float(x) for x in rows[rows[:, 1] == 0, 2]})
        for (blended, width), (label, colour) in KINDS.items():
            part = rows[rows[:, 1] == blended]
            if width is not None:
                part = part[part[:, 2] == widths[width]] if width < len(widths) else part[:0]
            if len(part):
                axis.errorbar(
                    part[:, 0], part[:, 3], yerr=part[:, 4], label=label, color=hex_of(colour), marker="o",
                    markersize=3, capsize=2,
                )  # fmt: skip
        chosen = rows[rows[:, -1] == 1][0]
        axis.plot(chosen[0], chosen[3], "o", markersize=11, fillstyle="none", color="black")
        axis.set(title=name, xlabel="regions", ylabel="held-out root mean square error")
    axes[0].legend(frameon=False, fontsize="small")
    figure.savefig(path, dpi=120)
