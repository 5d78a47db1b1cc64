"""Exports a recording in one pass, a batch of samples at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, get_args

from microdrivers.core.errors import UnsupportedError
from microdrivers.core.samples import Frame, Sample
from microdrivers.recording.channels import literal, matches
from microdrivers.recording.export.hdf5 import Hdf5File, text_widths
from microdrivers.recording.export.pictures import ImageFolder, VideoFile, track_of
from microdrivers.recording.export.tables import CsvTopic, ParquetTopic
from microdrivers.recording.export.target import file_names, staged
from microdrivers.recording.mcap_scan import Loss
from microdrivers.recording.reader import Recording
from microdrivers.recording.survey import TopicSummary
from microdrivers.recording.views import optional_module, start_ns, without_image

Format = Literal["csv", "parquet", "hdf5", "images", "video"]
FORMATS: tuple[Format, ...] = get_args(Format)

_NEEDS: Mapping[Format, str] = {"parquet": "pyarrow", "hdf5": "h5py"}
_FRAMES_ALONE: tuple[Format, ...] = ("images", "video")
_WITH_IMAGES: tuple[Format, ...] = ("hdf5", *_FRAMES_ALONE)
_REPORT_EVERY = 100


class TopicWriter(Protocol):
    """Writes one topic, `batch` samples at a time."""

    batch: int

    @property
    def remarks(self) -> Sequence[str]:
        """What is to be told of the closed file, and of what it lacks."""

    def write(self, samples: list[Sample]) -> None:
        """Append samples."""

    def close(self) -> None:
        """Complete what was written."""

    def verify(self) -> None:
        """Raise OSError or MicrodriversError if what was written and closed is not whole."""


class ExportReport(NamedTuple):
    """What was exported: number of samples by file or folder, and what could not be read or written."""

    written: Mapping[Path, int]
    losses: list[Loss]
    remarks: list[str]


def export_recording(
    recording: Recording,
    to: Format,
    out: Path,
    *,
    topics: Collection[str] | None = None,
    on_progress: Callable[[int, int], object] = lambda _done, _total: None,
) -> ExportReport:
    """Write a recording's topics to the folder `out`, which is made if it is not there.

    One file a topic (a folder of images for `images`), one for all of them for `hdf5`. What is wrong with the recording
    is in `<name>-flaws.txt` beside them. The files appear when all of them are complete; an export that fails or is
    interrupted leaves none.

    Args:
        recording: what is exported.
        to: one of `FORMATS`.
        out: a folder.
        on_progress: told samples done and in all.
        topics: names or patterns; default: all, and of `images` and `video` all cameras.

    Raises:
        UnsupportedError: no topic is left to export, or what the format needs is not installed.
        ConfigError: a file exists, or cannot be written.
    """
    if to in _NEEDS:
        optional_module(_NEEDS[to])
    chosen = _choose(recording, to, topics)
    names = file_names(chosen)
    suffix = {"csv": ".csv", "parquet": ".parquet", "images": "", "video": ".avi"}.get(to, "")
    files = {topic: f"{recording.file.stem}.h5" if to == "hdf5" else f"{names[topic]}{suffix}" for topic in chosen}
    flaws = "".join(f"{flaw}\n" for flaw in recording.flaws)
    told = f"{recording.file.stem}-flaws.txt"
    tells = bool(flaws) and not _holds(out / told, flaws)
    with staged(out, dict.fromkeys([*files.values(), *([told] if tells else [])])) as stage:
        if tells:
            (stage / told).write_text(flaws, encoding="utf-8")
        writers: dict[str, TopicWriter] = {}
        with ExitStack() as stack:
            make = _maker(recording, to, stage, files, names, stack, list(chosen))
            for topic, found in chosen.items():
                writers[topic] = make(topic, found)
                stack.callback(writers[topic].close)
            written = _write_batches(recording, writers, keeps_images=to in _WITH_IMAGES, on_progress=on_progress)
        for writer in writers.values():
            writer.verify()
    remarks = [f"{topic}: {remark}" for topic, writer in writers.items() for remark in writer.remarks]
    if flaws:
        remarks.append(f"{out / told}: what is wrong with the recording")
    by_file = Counter[Path]()
    for topic, number in written.items():
        by_file[out / files[topic]] += number
    return ExportReport(by_file, recording.losses, remarks)


def _write_batches(
    recording: Recording,
    writers: Mapping[str, TopicWriter],
    *,
    keeps_images: bool,
    on_progress: Callable[[int, int], object],
) -> Counter[str]:
    """Hand each topic's samples to its writer, and count them."""
    total = sum(recording.topics[topic].count for topic in writers)
    written = Counter(dict.fromkeys(writers, 0))
    waiting: dict[str, list[Sample]] = {topic: [] for topic in writers}
    for done, (topic, sample) in enumerate(recording.samples([literal(topic) for topic in writers]), 1):
        batch = waiting[topic]
        batch.append(sample if keeps_images else without_image(sample))
        written[topic] += 1
        if len(batch) >= writers[topic].batch:
            writers[topic].write(batch)
            waiting[topic] = []
        if done % _REPORT_EVERY == 0:
            on_progress(done, total)
    for topic, batch in waiting.items():
        if batch:
            writers[topic].write(batch)
    on_progress(written.total(), total)
    return written


def _choose(recording: Recording, to: Format, patterns: Collection[str] | None) -> dict[str, TopicSummary]:
    there = {name: found for name, found in recording.topics.items() if found.count}
    if to in _FRAMES_ALONE:
        there = {name: found for name, found in there.items() if found.sample_type is Frame}
    chosen = {name: found for name, found in there.items() if matches(name, patterns)}
    unknown = [pattern for pattern in patterns or () if not any(matches(name, [pattern]) for name in there)]
    if unknown or not chosen:
        no_frames = to in _FRAMES_ALONE and not there
        what = "no frames" if no_frames else f"nothing on {', '.join(unknown) or 'any topic'}"
        raise UnsupportedError(
            f"{recording.file} holds {what} to export to {to}",
            remedy=f"name some of {', '.join(there)}" if there else "`microdrivers info` tells what a file holds",
        )
    return chosen


def _maker(
    recording: Recording,
    to: Format,
    stage: Path,
    files: Mapping[str, str],
    names: Mapping[str, str],
    stack: ExitStack,
    topics: list[str],
) -> Callable[[str, TopicSummary], TopicWriter]:
    """What makes the writer of a topic."""
    start = start_ns(recording)
    if to == "csv":
        return lambda topic, found: CsvTopic(stage / files[topic], found.sample_type, start_ns=start)
    if to == "parquet":
        return lambda topic, found: ParquetTopic(stage / files[topic], found.sample_type, topic=topic, start_ns=start)
    if to == "images":
        return lambda topic, _: ImageFolder(stage / files[topic], track_of(recording, topic), start_ns=start)
    if to == "video":
        return lambda topic, found: VideoFile(stage / files[topic], rate_hz=found.usual_rate_hz)
    file = Hdf5File(stage / files[topics[0]], recording, start_ns=start)
    stack.callback(file.close)
    widths = text_widths(recording, topics)
    return lambda topic, found: file.topic(names[topic], topic, found.sample_type, widths.get(topic, {}))


def _holds(file: Path, text: str) -> bool:
    """Whether an earlier export of the recording has left that there."""
    return file.is_file() and file.read_bytes() == text.encode()
