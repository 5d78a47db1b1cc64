"""What a force characterisation says, as rows of text: the page and the terminal summary show the same."""

from __future__ import annotations

from typing import NamedTuple

from microdrivers.report.number_format import compact, significant, with_uncertainty
from microdrivers.results.force import PROTOCOLS, ForceResult, ProtocolName, ProtocolResult

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
    """One way to fit the model, as text; `weak` says why the record does not determine what."""

    key: ProtocolName
    name: str
    k1: Quantity
    k2: Quantity
    b: Quantity
    error: str
    noise: str
    weak: tuple[str, ...]
    paper: tuple[str, str, str, str]
    best: bool


class TruthRow(NamedTuple):
    """One parameter of the best fit beside the simulation's truth."""

    name: str
    value: str
    truth: str
    error: str


def protocol_rows(result: ForceResult) -> list[ProtocolRow]:
    """All fits, in the paper's order."""
    return [_row(result, name, result.protocols[name]) for name in PROTOCOLS if name in result.protocols]


def _row(result: ForceResult, key: ProtocolName, fit: ProtocolResult) -> ProtocolRow:
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
        weak=tuple(f"{name}: {known.reasons.get(name, 'not determined')}" for name in weak),
        paper=PAPER[key],
        best=key == result.best,
    )


def _number(value: float, sigma: float | None, *, weak: bool, scale: float = 1.0) -> Quantity:
    text = with_uncertainty(scale * value, None if sigma is None else FACTOR_95 * scale * sigma)
    return Quantity(text.value, text.plus_minus, weak)


def truth_rows(result: ForceResult) -> list[TruthRow]:
    """The best fit beside the truth; empty unless simulated."""
    truth = result.truth
    if truth is None:
        return []
    fit, slip = result.protocols[result.best], result.slip
    rows = [
        ("k1", fit.k1_uN_per_um, truth.k1_uN_per_um, "µN/µm"),
        ("k2", _K2_SCALE * fit.k2_uN_per_um3, _K2_SCALE * truth.k2_uN_per_um3, f"× {K2_UNIT}"),
        ("b", fit.b_uN_s_per_um, truth.b_uN_s_per_um, "µN·s/µm"),
    ]
    if slip is not None and truth.slip_offset_um:
        rows += [
            ("slip offset", slip.offset_um, truth.slip_offset_um, "µm"),
            ("slip rate", slip.rate_per_s, truth.slip_rate_per_s, "1/s"),
        ]
    return [
        TruthRow(name, f"{significant(value, 5)} {unit}", f"{compact(true)} {unit}", _percent(value, true))
        for name, value, true, unit in rows
    ]


def _percent(value: float, truth: float) -> str:
    return f"{significant(100.0 * (value / truth - 1.0), 2, signed=True)} %" if truth else ""


def slip_text(result: ForceResult) -> str:
    """The slip that eq. (26) found, in words; that it is not needed, if the best protocol has none; else empty."""
    slip = result.slip
    if slip is None:
        return ""
    if result.best != "slip_corrected":
        return "the best fit does without"
    offset = with_uncertainty(slip.offset_um, _half(slip.offset_sigma_um))
    rate = with_uncertainty(slip.rate_per_s, _half(slip.rate_sigma_per_s))
    return (
        f"offset {offset.value}{_plus(offset.plus_minus)} µm (paper: 25 µm), "
        f"α = {rate.value}{_plus(rate.plus_minus)} per s (not printed)"
    )


def _half(sigma: float | None) -> float | None:
    return None if sigma is None else FACTOR_95 * sigma


def _plus(half_width: str) -> str:
    return f" ± {half_width}" if half_width else ""


def excluded_text(result: ForceResult) -> str:
    """Which samples no fit used, in words; empty if all were."""
    return ", ".join(
        f"{count} {reason.replace('_', ' ')}" for reason, count in result.excluded_samples.items() if count
    )
