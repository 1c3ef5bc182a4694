"""`python -m raytransfer`: the table, the figures, and a report that stands alone."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from PIL import Image

from raytransfer import report
from raytransfer.thesis import claims

if TYPE_CHECKING:
    from pathlib import Path


def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "raytransfer", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


def test_run_writes_all_and_says_how_to_go_on(tmp_path: Path) -> None:
    result = run("--output", "out", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for claim in claims():
        assert claim.id in result.stdout
    assert "make lab" in result.stdout
    figures = {path.stem for path in (tmp_path / "out" / "figures").iterdir()}
    assert figures == set(report.FIGURES)
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("<img ") == len(report.FIGURES)
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert all(source.startswith("data:") for source in sources)  # nothing outside the file
    for claim in claims():
        assert f"<td>{claim.id}</td>" in page


def test_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    result = run("--output", "file", cwd=tmp_path)
    assert result.returncode == 1
    assert "cannot be written" in result.stdout
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("name", report.FIGURES)
def test_figure_is_reproducible_and_not_blank(name: str) -> None:
    png, caption = report.draw(name)
    assert (png, caption) == report.draw(name)
    low, high = Image.open(io.BytesIO(png)).convert("L").getextrema()
    assert (low, high) != (high, high)
    assert caption.endswith(".")
