"""Recorded indentations: read with every mistake named, published as a live rig publishes, written and read again."""

import math

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.contact_samples import DeformationSample, IndentationSample
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import ForceSample
from microdrivers.recording.indentation_table import IndentationTable, write_indentation_table

ROWS = """# by hand
time_s,indentation_um,force_uN,segment
0.0,0.5,1.0,loading
0.033333,0.6,1.25,loading
0.066667,0.7,{},loading
"""


def table(tmp_path, text):
    file = tmp_path / "indentation.csv"
    file.write_text(text)
    return file


def published(file):
    bus, forces, deformations = Bus(), [], []
    bus.topic("force", ForceSample).subscribe(forces.append)
    bus.topic("deformation", DeformationSample).subscribe(deformations.append)
    IndentationTable(file).publish(bus, sensor="force", deformation="deformation")
    return forces, deformations


def test_each_row_is_a_force_and_a_deformation_of_one_time(tmp_path):
    forces, deformations = published(table(tmp_path, ROWS.format("1.5")))
    assert [sample.force_uN for sample in forces] == [1.0, 1.25, 1.5]
    assert [sample.deformation_um for sample in deformations] == [0.5, 0.6, 0.7]
    assert [f.t_ns for f in forces] == [d.t_ns for d in deformations] == [0, 33_333_000, 66_667_000]
    assert all(f.order < d.order for f, d in zip(forces, deformations, strict=True))
    assert all(sample.t_source == "recorded" for sample in (*forces, *deformations))


@pytest.mark.parametrize("cell", ["", "nan"])
def test_a_missing_force_was_not_measured(tmp_path, cell):
    forces, _ = published(table(tmp_path, ROWS.format(cell)))
    assert math.isnan(forces[-1].force_uN)
    assert forces[-1].flags == {"NOT_MEASURED"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("force_uN", "force_mN"), r"indentation\.csv:2:1: column force_uN is missing"),
        (("0.6,1.25", "0.6,much"), r"indentation\.csv:4:3: force_uN: 'much' is not a finite number"),
        (("0.033333", "0.0"), r"indentation\.csv:4:1: time_s: time does not increase"),
        (("0.033333", "nan"), r"indentation\.csv:4:1: time_s: 'nan' is not a finite number"),
        (("0.6,1.25,loading", "0.6"), r"indentation\.csv:4:2: the row has 2 cells, the header 4"),
        (("segment", "force_uN"), r"indentation\.csv:2:4: column force_uN is there more than once"),
        ((",", ";"), r"indentation\.csv:2:1: the cells are separated by semicolons"),
        ((",", "\t"), r"indentation\.csv:2:1: the cells are separated by tabs"),
        (("0.6,1.25,loading", "0,6,1.25,loading"), r"indentation\.csv:4:5: the row has 5 cells.*\n.*decimal point"),
        (("0.6,1.25", '"0,6",1.25'), r"indentation\.csv:4:2: indentation_um: '0,6' has a decimal comma"),
        (("0.033333", "1732286792000"), r"indentation\.csv:4:1: time_s: 1732286792000 is beyond 1e\+10"),
        ((ROWS, "# nothing\ntime_s,indentation_um,force_uN\n"), "the table has no rows"),
    ],
)
def test_a_mistake_has_its_line_and_column(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        IndentationTable(table(tmp_path, ROWS.replace(*change).replace("{}", "1.5")))


def test_time_may_count_from_an_epoch(tmp_path):
    text = ROWS.format("1.5")
    for seconds in ("0.0,", "0.033333,", "0.066667,"):
        text = text.replace(f"\n{seconds}", f"\n{1732286792.0 + float(seconds[:-1]):.6f},")
    forces, _ = published(table(tmp_path, text))
    assert forces[2].t_ns - forces[0].t_ns == pytest.approx(66_667_000, abs=1000)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"no\.csv.*there is no such file"):
        IndentationTable(tmp_path / "no.csv")


def test_what_is_not_text_is_refused(tmp_path):
    file = tmp_path / "binary.csv"
    file.write_bytes(bytes(range(256)))
    with pytest.raises(ConfigError, match="cannot be read as a table"):
        IndentationTable(file)


def test_what_was_measured_reads_back_with_the_same_bits(tmp_path):
    samples = [
        IndentationSample(
            t_ns=1_000_000_000 + 33_333_333 * k, device="d", deformation_um=k / 3, deformation_sigma_um=0.05,
            force_uN=math.sqrt(k), force_sigma_uN=0.01, readings=2, frame_seq=k,
        )
        for k in range(20)
    ]  # fmt: skip
    write_indentation_table(tmp_path / "record.csv", samples)
    forces, deformations = published(tmp_path / "record.csv")
    assert [sample.force_uN for sample in forces] == [sample.force_uN for sample in samples]
    assert [sample.deformation_um for sample in deformations] == [sample.deformation_um for sample in samples]
    assert [sample.t_ns for sample in forces] == [33_333_333 * k for k in range(20)]
