"""Files in OUT: whole or not at all."""

import json
import os
from pathlib import Path

import polars as pl
import pytest

from rsa_vision.errors import UsageError
from rsa_vision.store import fingerprint, is_finished, read_tables, record_path, write_atomic, write_tables
from rsa_vision.tables import SCHEMAS, failed_rows

# what is published of the columns: docs/files.md
PUBLISHED = {
    "exams": "subject, exam, status, reasons, files, method, n_markers, mean_parallax_um, seconds",
    "images": "subject, exam, focus, role, number, shape, col_px, row_px, sd_col_px, sd_row_px, cov_col_row_px2, x_mm, y_mm, z_mm, "
    "residual_um, used, flags, file",
    "foci": "subject, exam, focus, x_mm, y_mm, z_mm, sd_x_mm, sd_y_mm, sd_z_mm, fiducial_rmse_um, fiducial_max_um, line_rmsv_um, "
    "line_max_um, n_fiducials, n_controls",
    "markers": "subject, exam, segment, marker, x_mm, y_mm, z_mm, sd_x_mm, sd_y_mm, sd_z_mm, cov_xy_mm2, cov_xz_mm2, cov_yz_mm2, "
    "crossing_um, parallax_um, n_views, flags",
}


@pytest.mark.parametrize("table", PUBLISHED)
def test_columns_are_the_published_ones(table: str) -> None:
    assert set(PUBLISHED[table].split(", ")) <= set(SCHEMAS[table])


def test_a_failure_while_writing_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "exams.csv"
    write_atomic(path, b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UsageError, match="No space left"):
        write_atomic(path, b"new, longer")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(UsageError, match="another place with -o"):
        write_atomic(tmp_path / "file" / "exams.csv", b"")


def test_tables_keep_every_digit_and_empty_means_not_determined(tmp_path: Path) -> None:
    rows = failed_rows("S,1", "2", ["a.tif", "b.tif"], "film-missing", 'no "film"')
    marker = {
        "subject": "S,1",
        "exam": "2",
        "segment": "",
        "marker": "P01",
        "x_mm": 1 / 3,
        "y_mm": float("nan"),
        "n_views": 1,
        "flags": "one-view",
    }
    write_tables(tmp_path, [rows | {"markers": [marker]}])
    text = (tmp_path / "markers.csv").read_text()
    assert "nan" not in text.lower()
    for table in (read_tables(tmp_path)["markers"], pl.read_parquet(tmp_path / "results.parquet" / "markers.parquet")):
        (row,) = table.to_dicts()
        assert row["x_mm"] == 1 / 3
        assert row["y_mm"] is None
        assert row["subject"] == "S,1"
    assert (tmp_path / "images.csv").read_text().count("\n") == 1


def test_results_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no results"):
        read_tables(tmp_path)


def test_records_of_different_examinations_never_share_a_file(tmp_path: Path) -> None:
    names = [("a", "b_c"), ("a_b", "c"), ("a/b", "c"), ("a:b", "c"), ("../a", "c"), ("ä", "c"), ("", "c"), ("a" * 300, "c"), (".a", "c")]
    paths = [record_path(tmp_path, *name) for name in names]
    assert len(set(paths)) == len(names)
    assert all(path.parent == tmp_path / "exams" and len(path.name) < 120 and not path.name.startswith(".") for path in paths)


def test_a_record_counts_only_for_the_same_inputs_and_a_settled_result() -> None:
    wanted = fingerprint({"films": {"a.tif": "00"}})
    assert wanted != fingerprint({"films": {"a.tif": "01"}})
    record = {"fingerprint": wanted, "rows": failed_rows("S", "1", [], "cage-not-found", "")}
    assert is_finished(json.loads(json.dumps(record)), wanted)
    assert not is_finished(record, fingerprint({}))
    assert not is_finished(None, wanted)
    for code in ("internal", "timeout"):
        assert not is_finished({"fingerprint": wanted, "rows": failed_rows("S", "1", [], code, "")}, wanted)
