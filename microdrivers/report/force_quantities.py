"""What a force characterisation says, as rows of text: the page and the terminal summary show the same."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from microdrivers.core.protocol_names import PROTOCOLS, ProtocolName
from microdrivers.report.number_format import compact, significant, with_uncertainty, without_exponents
from microdrivers.results.force import ForceResult, VisionCheck

FACTOR_95 = 1.96
K2_UNIT = "10⁻⁶ µN/µm³"
_K2_SCALE = 1e6

NAMES: dict[ProtocolName, str] = {
    "single": "one model for loading and unloading",
    "unloading_springs": "springs from unloading, damper from loading",
    "loading_only": "all from loading, no damper unloading",
    "slip_corrected": "the same after eq. (26)",
    "loading": "the loading part alone",
}

PAPER: dict[ProtocolName, tuple[str, str, str, str]] = {
    "single": ("4.5161", "100", "27.7200", "3.89 %"),
    "unloading_springs": ("2.9577", "100", "51.3317", "5.22 %"),
    "loading_only": ("", "", "", "10.72 %"),
    "slip_corrected": ("5.8781", "38.346", "1.1834", "3.6 %"),
    "loading": ("", "", "", ""),
}
"""k1 (µN/µm), k2 (10⁻⁶ µN/µm³), b (µN·s/µm) and error, Bilen et al., section III.C, each from an embryo of its own."""

_AS_STIFF = (0.3, 60.0)
"""k1 (µN/µm), a tenth of the paper's softest to ten times its stiffest: others have nothing to do with its embryos."""

_WIDE = "its 95 % interval is wide"
_AT_THE_REVERSAL_S = 0.5


class Quantity(NamedTuple):
    """A parameter as text; in brackets if the record does not determine it. `plus_minus`: half of its 95 % interval."""

    value: str
    plus_minus: str
    weak: bool

    @property
    def shown(self) -> str:
        """The value by itself."""
        return f"({self.value})" if self.weak else self.value

    @property
    def text(self) -> str:
        """In one line."""
        line = f"{self.value} ± {self.plus_minus}" if self.plus_minus else self.value
        return f"({line})" if self.weak else line


class ProtocolRow(NamedTuple):
    """One way to fit the model, as text; `weak` holds (parameter, why it is not determined), `paper` may be empty."""

    key: ProtocolName
    name: str
    k1: Quantity
    k2: Quantity
    b: Quantity
    error: str
    noise: str
    weak: tuple[tuple[str, str], ...]
    paper: tuple[str, ...]
    best: bool


class TruthRow(NamedTuple):
    """One parameter of the best fit beside the simulation's truth; in brackets if the record does not determine it."""

    name: str
    value: str
    truth: str
    error: str


def protocol_rows(result: ForceResult) -> list[ProtocolRow]:
    """All fits, in the paper's order; with the paper's figures, unless they have nothing to do with any of them."""
    names = [name for name in PROTOCOLS if name in result.protocols]
    as_stiff = _AS_STIFF[0] <= result.protocols[result.best].k1_uN_per_um <= _AS_STIFF[1]
    beside = as_stiff and any(any(PAPER[name]) for name in names)
    return [_row(result, name, PAPER[name] if beside else ()) for name in names]


def _row(result: ForceResult, key: ProtocolName, paper: tuple[str, ...]) -> ProtocolRow:
    fit = result.protocols[key]
    known = fit.identifiable
    weak = tuple(name for name in ("k1", "k2", "b") if not getattr(known, name))
    return ProtocolRow(
        key=key,
        name=NAMES[key],
        k1=_number(fit.k1_uN_per_um, fit.k1_sigma_uN_per_um, weak="k1" in weak),
        k2=_number(fit.k2_uN_per_um3, fit.k2_sigma_uN_per_um3, weak="k2" in weak, scale=_K2_SCALE),
        b=_number(fit.b_uN_s_per_um, fit.b_sigma_uN_s_per_um, weak="b" in weak),
        error=f"{significant(fit.error_percent, 3)} %",
        noise="" if fit.noise_residual_ratio is None else f"{significant(fit.noise_residual_ratio, 2)} ×",
        weak=tuple((name, reason) for name in weak for reason in _foremost(known.reasons.get(name, ""))),
        paper=paper,
        best=key == result.best,
    )


def _foremost(reasons: str) -> list[str]:
    """Of a number that comes from a misfit, that is all that need be said; `result.json` has the rest."""
    found = reasons.split("; ")
    return [reason for reason in found if reason.startswith("the model does not explain")] or found


def weak_lines(rows: Sequence[ProtocolRow]) -> list[str]:
    """Why values stand in brackets: one line for all protocols of which the same is true."""
    protocols: dict[str, list[str]] = {}
    for row in rows:
        names: dict[str, list[str]] = {}
        for name, reason in row.weak:
            said = _WIDE if reason.startswith("95 % interval") else without_exponents(reason) or "not determined"
            names.setdefault(said, []).append(name)
        if names:
            text = "; ".join(f"{', '.join(which)}: {said}" for said, which in names.items())
            protocols.setdefault(text, []).append(row.key)
    return [f"{', '.join(keys)} – {text}" for text, keys in protocols.items()]


def pressed_text(result: ForceResult) -> str:
    """How the specimen was pressed: depth, force, and speeds in and out."""
    setup = result.setup
    force = f"{significant(setup.largest_force_uN, 4)} µN"
    if result.excluded_samples.get("saturated"):
        force = f"beyond {force}, where the sensor’s range ends"
    speed = f"in at {compact(setup.speed_um_s)} µm/s"
    if setup.unloading_speed_um_s is not None:
        speed += f", back at {compact(setup.unloading_speed_um_s)} µm/s"
    pressed_um = setup.deepest_um if setup.pressed_um is None else setup.pressed_um
    return f"{significant(pressed_um, 4)} µm, {force}; {speed}"


def valid_depth_text(result: ForceResult) -> str:
    """How deep the best model is valid, and in which coordinate."""
    depth = f"compression up to {significant(result.setup.deepest_um, 4)} µm"
    slips = result.best == "slip_corrected"
    return f"{depth}: x* of eq. (26), the slip taken off" if slips else f"{depth} from the undeformed surface"


def valid_speed_text(result: ForceResult) -> str:
    """How fast the best model is valid."""
    setup = result.setup
    speed = f"up to {compact(setup.fastest_um_s or setup.speed_um_s)} µm/s in"
    if setup.unloading_speed_um_s is None or setup.fastest_unloading_um_s is None:
        return speed
    return f"{speed}, {compact(setup.fastest_unloading_um_s)} µm/s back"


def camera_text(check: VisionCheck) -> str:
    """How well the camera alone told the force of a fresh indentation, and where it was worst."""
    worst = f"at most {significant(check.largest_error_uN, 3)} µN off"
    if check.largest_error_s is not None and check.deepest_s is not None:
        near = abs(check.largest_error_s - check.deepest_s) < _AT_THE_REVERSAL_S
        worst += ", at the reversal" if near else f", at {check.largest_error_s:.1f} s"
    return f"force within {significant(check.error_percent, 2)} % RMS of the sensor’s in a fresh indentation; {worst}"


def _number(value: float, sigma: float | None, *, weak: bool, scale: float = 1.0) -> Quantity:
    text = with_uncertainty(scale * value, None if sigma is None else FACTOR_95 * scale * sigma)
    return Quantity(text.value, text.plus_minus, weak)


def truth_rows(result: ForceResult) -> list[TruthRow]:
    """The best fit beside the truth; empty unless simulated."""
    truth = result.truth
    if truth is None:
        return []
    fit, slip = result.protocols[result.best], result.slip
    known = fit.identifiable
    rows = [
        ("k1", fit.k1_uN_per_um, truth.k1_uN_per_um, "µN/µm", known.k1),
        ("k2", _K2_SCALE * fit.k2_uN_per_um3, _K2_SCALE * truth.k2_uN_per_um3, f"× {K2_UNIT}", known.k2),
        ("b", fit.b_uN_s_per_um, truth.b_uN_s_per_um, "µN·s/µm", known.b),
    ]
    if slip is not None and truth.slip_offset_um and result.best == "slip_corrected":
        rows += [
            ("slip offset", slip.offset_um, truth.slip_offset_um, "µm", slip.identifiable),
            ("slip rate", slip.rate_per_s, truth.slip_rate_per_s, "1/s", slip.identifiable),
        ]
    return [_truth_row(*row) for row in rows]


def _truth_row(name: str, value: float, true: float, unit: str, known: bool) -> TruthRow:
    found = f"{significant(value, 5)} {unit}"
    error = f"{significant(100.0 * (value / true - 1.0), 2, signed=True)} %" if true else ""
    if not known:
        found, error = (f"({text})" if text else "" for text in (found, error))
    return TruthRow(name, found, f"{compact(true)} {unit}", error)


def slip_text(result: ForceResult) -> str:
    """The slip that eq. (26) found, in words; if the best protocol has none, that and why; empty if none was fitted."""
    slip = result.slip
    if slip is None:
        return ""
    # That an interval is wide is seen.
    why = "; ".join(dict.fromkeys(_WIDE if "95 % interval" in each else each for each in slip.reason.split("; ")))
    if result.best != "slip_corrected":
        does_without = "the best fit does without"
        return f"{does_without}, though with it the error is less: {why}" if slip_fits_better(result) else does_without
    offset = with_uncertainty(slip.offset_um, _half(slip.offset_sigma_um))
    rate = with_uncertainty(slip.rate_per_s, _half(slip.rate_sigma_per_s))
    offset_text = f"{offset.value}{_plus(offset.plus_minus)} µm"
    rate_text = f"{rate.value}{_plus(rate.plus_minus)} per s"
    if not slip.identifiable:
        return f"(offset {offset_text}, α = {rate_text}), not to be quoted: {without_exponents(why)}"
    return f"offset {offset_text} (paper: 25 µm), α = {rate_text} (not printed)"


def slip_fits_better(result: ForceResult) -> bool:
    """Whether a slip would lessen the error of a best protocol that has none."""
    best, slipped = result.protocols[result.best], result.protocols.get("slip_corrected")
    return slipped is not None and result.best != "loading" and slipped.error_percent < best.error_percent


def _half(sigma: float | None) -> float | None:
    return None if sigma is None else FACTOR_95 * sigma


def _plus(half_width: str) -> str:
    return f" ± {half_width}" if half_width else ""


def excluded_text(result: ForceResult) -> str:
    """Which samples no fit used, in words; empty if all were."""
    return ", ".join(
        f"{count} {reason.replace('_', ' ')}" for reason, count in result.excluded_samples.items() if count
    )
