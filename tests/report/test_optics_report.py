import re
from html.parser import HTMLParser

import matplotlib
import numpy as np
import pytest

from microdrivers.estimators.optics import student_factor
from microdrivers.report.number_format import with_uncertainty
from microdrivers.report.optics_report import optics_report_html, write_optics_report

# The pages are made once, by one worker.
pytestmark = pytest.mark.xdist_group("optics report")

CASES = {
    "zoom change": {},
    "interrupted, real": {
        "frames": 60, "complete": False, "with_truth": False, "magnification": False,
        "provenance": {"fake": False, "clock": "system", "seed": None},
    },
    "no zoom change, no noise, errors undefined at the start": {
        "zoom_change": False, "noise_px": 0.0, "prediction_error_px": [None] * 20 + [0.02] * 80,
    },
    "image sequence": {
        "frames": 30, "zoom_change": False, "with_truth": False, "magnification": False,
        "provenance": {"fake": False, "clock": "recorded", "seed": None, "devices": {}, "settings": {}, "rig": {}},
    },
    "four frames, no interval, no error": {
        "frames": 4, "zoom_change": False, "degrees_of_freedom": 0.0, "scale_sigma_px_per_um": 0.0, "notes": [],
        "prediction_error_px": [None] * 4, "posterior_error_px": [None] * 4,
    },
}  # fmt: skip
VOID = {"meta", "link", "br", "img", "input", "hr"}


class Page(HTMLParser):
    """Checks that the tags nest; gathers the visible text, identifiers and addresses."""

    def __init__(self, html):
        super().__init__()
        self.open, self.text, self.tags = [], [], []
        self.ids, self.addresses = [], []
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self._note(tag, attributes)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self._note(tag, attributes)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script"} & set(self.open):
            self.text.append(data)

    def _note(self, tag, attributes):
        self.tags.append(tag)
        for name, value in attributes:
            assert not name.startswith("on")
            if name == "id":
                self.ids.append(value)
            if name in ("href", "src", "xlink:href", "srcset", "action", "data"):
                self.addresses.append(value)

    def visible(self):
        return re.sub(r"\s+", " ", " ".join(self.text))


@pytest.fixture(scope="module")
def pages(make_result):
    """The page of each case, made once."""
    return {name: optics_report_html(make_result(**case)) for name, case in CASES.items()}


@pytest.fixture(params=list(CASES))
def html(request, pages):
    return pages[request.param]


def test_page_is_whole_and_self_contained(html):
    page = Page(html)
    assert page.open == []
    assert "script" not in page.tags
    assert all(address.startswith(("#", "data:")) for address in page.addresses)
    assert not re.search(r"@import|url\((?!#)", html)
    assert len(html) < 1_500_000
    assert page.tags.count("svg") == 4


def test_identifiers_are_unique_and_exist(html):
    page = Page(html)
    assert len(page.ids) == len(set(page.ids))
    used = re.findall(r"url\(#([^)]*)\)", html) + [a[1:] for a in page.addresses if a.startswith("#")]
    assert set(used) <= set(page.ids)


def test_nothing_undefined_shows(html):
    visible = Page(html).visible()
    for word in (r"\bnan\b", r"\bNone\b", r"\binf\b", r"\bnull\b", r"\bTrue\b", r"\{\{", r"Undefined"):
        match = re.search(word, visible.replace("serial: null", ""))
        assert match is None, visible[max(0, match.start() - 40) : match.end() + 40]


def test_colours_follow_the_page(html):
    drawn = "".join(re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL))
    assert set(re.findall(r"#[0-9a-f]{6}\b", drawn)) <= {"#ffffff", "#000000"}
    assert "font-family" not in drawn
    assert "<style" not in drawn


def test_says_what_it_is(pages):
    page = Page(pages["zoom change"]).visible()
    for words in ("simulated", "complete", "camera_fine to stage at zoom 1.2", "2025-03-04 09:15 UTC", "1.5×",
                  "640 × 480 px from (0, 0)", "paper: 8 iterations (0.26 s)", "Seed 7", "(paper: Fig. 4)",
                  "1 frame had no pose", "tilt or stage/pixel anisotropy", "−2.5", "not set"):  # fmt: skip
        assert words in page
    interrupted = Page(pages["interrupted, real"]).visible()
    assert "The run was interrupted" in interrupted
    assert "real hardware" in interrupted
    assert "recorded" in Page(pages["image sequence"]).visible()
    assert "Too few frames for 95 % intervals" in pages["four frames, no interval, no error"]


def test_table_shows_the_estimate_with_its_interval(make_result, pages):
    result = make_result()
    half_width = student_factor(result.degrees_of_freedom) * result.scale_sigma_px_per_um
    expected = with_uncertainty(result.scale_px_per_um, half_width)
    assert f"{expected.value} ± {expected.plus_minus} px/µm" in Page(pages["zoom change"]).visible()


def test_strings_of_the_rig_file_are_escaped(make_result):
    hostile = "<script>alert('x')</script>\"&</pre></title><img src=x onerror=y>"
    result = make_result(
        notes=[hostile],
        provenance={
            "rig_name": hostile, "rig_file": hostile, "command": hostile, "source": hostile, "created_utc": hostile,
            "rig": {hostile: hostile}, "devices": {hostile: {hostile: hostile}}, "settings": {hostile: [hostile]},
            "platform": hostile,
        },
    )  # fmt: skip
    result = result.model_copy(
        update={
            "valid_for": result.valid_for.model_copy(update={"camera": hostile}),
            "tilt": result.tilt.model_copy(update={"label": hostile}),
        }
    )
    html = optics_report_html(result)
    page = Page(html)
    assert "<script" not in html
    assert "img" not in page.tags
    assert page.visible().count("alert('x')") >= 9


def test_without_a_change_there_is_no_close_up(pages):
    with_change, without = pages["zoom change"], pages["image sequence"]
    assert "around the zoom change" in with_change
    assert "within 0.1 px from" in with_change
    assert "(b) around" not in without
    assert "After the zoom change" not in without


def test_no_frames(make_result):
    result = make_result()
    empty = {name: [] for name in type(result.traces).model_fields}
    html = optics_report_html(
        result.model_copy(
            update={
                "traces": result.traces.model_copy(update=empty),
                "prediction_error_px": [], "posterior_error_px": [], "magnification_trace": [], "zoom_change": None,
            }
        )
    )  # fmt: skip
    assert "The run holds no frames." in html
    assert "<svg" not in html


def test_long_run_stays_small_and_keeps_its_extremes(make_result):
    result = make_result(zoom_change=False)
    times = 200
    n = 100 * times
    traces = {name: list(getattr(result.traces, name)) * times for name in type(result.traces).model_fields}
    traces["frame"] = list(range(n))
    traces["time_s"] = (np.arange(n) / 30.0).tolist()
    errors = [0.01] * n
    errors[12_345] = 5.0
    html = optics_report_html(
        result.model_copy(
            update={
                "traces": result.traces.model_copy(update=traces),
                "prediction_error_px": errors, "posterior_error_px": [0.01] * n,
                "magnification_trace": list(result.magnification_trace) * times,
            }
        )
    )  # fmt: skip
    assert len(html) < 1_500_000
    error_figure = re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)[2]
    (curve,) = re.findall(r'<path d="([^"]*)"[^>]*style="fill: none; stroke: var\(--blue\)', error_figure)
    heights = [float(y) for y in re.findall(r"[ML] [\d.]+ ([\d.]+)", curve)]
    assert max(heights) - min(heights) > 100


def test_file_is_written_the_same_every_time(make_result, pages, tmp_path):
    before = dict(matplotlib.rcParams)
    write_optics_report(make_result(), tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == pages["zoom change"]
    assert dict(matplotlib.rcParams) == before
