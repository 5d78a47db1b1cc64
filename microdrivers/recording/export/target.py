"""Where an export goes: nothing is overwritten, and what was not finished is not left behind."""

from __future__ import annotations

import contextlib
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from microdrivers.core.errors import ConfigError

_UNSAFE = re.compile(r"[^\w.-]+")


def file_names(topics: Iterable[str]) -> Mapping[str, str]:
    """A file name, without suffix, for each topic: `a/b` becomes `a-b`; no two names are alike."""
    names: dict[str, str] = {}
    taken: set[str] = set()
    for topic in topics:
        plain = _UNSAFE.sub("_", topic.replace("/", "-")).lstrip(".") or "topic"
        name, number = plain, 1
        while name.casefold() in taken:
            number += 1
            name = f"{plain}-{number}"
        taken.add(name.casefold())
        names[topic] = name
    return names


@contextmanager
def staged(out: Path, names: Iterable[str]) -> Iterator[Path]:
    """A folder to write files or folders of these names in; they appear in `out` when all of them are complete.

    Raises:
        ConfigError: one of them is there already, or nothing can be written there.
    """
    targets = [out / name for name in names]
    for target in targets:
        _refuse_existing(target)
    is_new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=".export-", dir=out))
    except OSError as error:
        raise not_writable(out, error) from error
    try:
        yield stage
        for target in targets:
            _refuse_existing(target)
            if (stage / target.name).exists():
                (stage / target.name).rename(target)
    except OSError as error:
        raise not_writable(out, error) from error
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if is_new:
            with contextlib.suppress(OSError):  # it is not empty: all went well
                out.rmdir()


def _refuse_existing(target: Path) -> None:
    if target.exists():
        raise ConfigError(
            "it already exists, and an export never overwrites anything", file=str(target),
            remedy="choose another --out folder, or remove it",
        )  # fmt: skip


def not_writable(out: Path, error: OSError) -> ConfigError:
    """What to tell the user of a folder that cannot be written."""
    return ConfigError(
        f"nothing can be written there: {error.strerror or error}", file=str(out),
        remedy="choose another --out folder, on a disk with space left",
    )  # fmt: skip
