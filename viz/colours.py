"""One palette for every picture: Okabe and Ito's colours, told apart by colour-blind readers too.

Sources: M. Okabe, K. Ito, "Color Universal Design", 2008; the ramp is cividis (J. R. Nuñez et al., PLoS ONE
13, 2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Colour = tuple[int, int, int]

SKY_BLUE: Colour = (86, 180, 233)
ORANGE: Colour = (230, 159, 0)
GREEN: Colour = (0, 158, 115)
YELLOW: Colour = (240, 228, 66)
PURPLE: Colour = (204, 121, 167)
VERMILLION: Colour = (213, 94, 0)
BLUE: Colour = (52, 134, 200)  # lighter than the original (0, 114, 178), which sinks into a dark background
SAND: Colour = (194, 178, 128)
WHITE: Colour = (240, 240, 240)
GREY: Colour = (150, 150, 150)
DIM: Colour = (66, 72, 76)

CYCLE = (SKY_BLUE, ORANGE, GREEN, PURPLE, YELLOW, VERMILLION, BLUE, SAND)
EXCEEDANCE: Colour = (255, 82, 62)
DETECTED = YELLOW
INJECTED = WHITE

_FAULTS: dict[str, Colour] = {
    "none": DIM,
    "insufficient_evidence": GREY,
    "unknown": WHITE,
    "maf_gain": SKY_BLUE,
    "boost_pressure_gain": PURPLE,
    "intake_pressure_gain": YELLOW,
    "boost_leak": VERMILLION,
    "intake_leak": GREEN,
    "intake_temperature_gain": ORANGE,
    "egr_stuck_open": BLUE,
    "egr_stuck_closed": SAND,
    "sensor_stuck": (105, 45, 255),
    "sensor_noise": (255, 255, 150),
    "sensor_offset": (150, 60, 180),
    "tps_time_constant": SKY_BLUE,
    "tps_gain": ORANGE,
    "motor_torque_constant": GREEN,
    "back_emf_constant": PURPLE,
}
EVERY = (*CYCLE, WHITE, GREY, DIM, EXCEEDANCE, *_FAULTS.values())
_CIVIDIS: NDArray[np.float64] = np.array(
    [(0, 34, 78), (59, 73, 108), (112, 113, 115), (165, 153, 108), (219, 196, 80), (254, 232, 56)],
    dtype=float,
)


def of_index(index: int) -> Colour:
    """The colour of the ``index``-th series or regime; they repeat after eight."""
    return CYCLE[index % len(CYCLE)]


def of_fault(name: str) -> Colour:
    """The same colour for a fault wherever it is drawn; several at once have the colours' mean.

    >>> of_fault("boost_leak") == VERMILLION
    True
    >>> of_fault("boost_leak+maf_gain")
    (150, 137, 116)
    """
    parts = [_FAULTS.get(part) or of_index(sum(part.encode())) for part in name.split("+")]
    red, green, blue = np.mean(parts, axis=0).round().astype(int).tolist()
    return red, green, blue


def hex_of(colour: Colour) -> str:
    """
    >>> hex_of(ORANGE)
    '#e69f00'
    """
    return "#" + "".join(f"{part:02x}" for part in colour)


def luminance(colour: Colour) -> float:
    """Relative luminance, 0 to 1, as the Web Content Accessibility Guidelines 2.1 define it."""
    s = np.array(colour) / 255.0
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def on_paper(colour: Colour, contrast: float = 3.0) -> Colour:
    """The colour, darkened until lines of it have that contrast on white; white and the dim grey change
    places with what they are on a dark background.

    >>> on_paper(WHITE), on_paper(VERMILLION)
    ((40, 40, 40), (213, 94, 0))
    """
    if colour in (WHITE, DIM):
        return (40, 40, 40) if colour == WHITE else (205, 210, 214)
    share = 1.0
    while 1.05 / (luminance(shaded := _times(colour, share)) + 0.05) < contrast:
        share -= 0.02
    return shaded


def _times(colour: Colour, share: float) -> Colour:
    red, green, blue = (round(part * share) for part in colour)
    return red, green, blue


def ramp(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Cividis from the least (dark) to the greatest value (bright), shape (n, 3); grey where not finite.

    >>> ramp(np.array([0.0, 1.0])).tolist()
    [[59, 73, 108], [254, 232, 56]]
    """
    finite = np.isfinite(values)
    low, high = (values[finite].min(), values[finite].max()) if finite.any() else (0.0, 0.0)
    place = np.where(finite, (values - low) / ((high - low) or 1.0), 0.0)
    stops = np.linspace(0.0, 1.0, len(_CIVIDIS) - 1)  # without the darkest, lost on a dark background
    colours = np.stack([np.interp(place, stops, _CIVIDIS[1:, channel]) for channel in range(3)], axis=1)
    colours[~finite] = GREY
    return colours.round().astype(np.uint8)
