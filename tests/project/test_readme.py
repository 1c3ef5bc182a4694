"""The README says what is so: its examples run, its tables are the program's."""

from __future__ import annotations

import doctest
import re
import shlex
import subprocess
import sys
from pathlib import Path

from raytransfer.thesis import claims

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_examples_give_what_is_printed() -> None:
    result = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert result.attempted >= 10
    assert result.failed == 0


def test_table_of_claims_is_up_to_date() -> None:
    for claim in claims():
        assert "| " + " | ".join(claim.cells()[:5]) + " |" in README
    quoted = [claim for claim in claims() if claim.quoted]
    assert len(quoted) == 12
    assert [claim.id for claim in quoted if not claim.agrees] == ["O7", "O9"]


def test_links_and_commands_exist() -> None:
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert links
    for link in links:
        assert (ROOT / link).exists(), link
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"\bmake ([a-z]+)", README)):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), f"make {target}"


def test_linetrack_commands_run(tmp_path: Path) -> None:
    lines = [
        line.partition("#")[0].strip()
        for block in re.findall(r"```sh\n(.*?)```", README, flags=re.DOTALL)
        for line in block.splitlines()
        if line.startswith(".venv/bin/linetrack")
    ]
    assert {shlex.split(line)[1] for line in lines} == {
        "capture",
        "plot",
        "info",
        "live",
        "convert",
        "track",
        "build",
    }
    for line in lines:
        words = shlex.split(line)
        words[0] = str(Path(sys.executable).with_name("linetrack"))
        if words[1] == "live":
            words += ["--frames", "4"]  # or it waits for a key
        elif words[1] == "track" and not {"-n", "--count"} & set(words):
            words += ["--count", "4"]  # or it follows for ever
        subprocess.run(words, cwd=tmp_path, check=True, capture_output=True, timeout=300)


def test_every_notebook_is_listed() -> None:
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        assert f"(notebooks/{path.name})" in README


def test_notebooks_carry_every_claim() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "notebooks").glob("*.ipynb"))
    shown = re.findall(r"\| (O\d+) \|", sources)
    assert sorted(shown) == sorted(claim.id for claim in claims())  # each in one notebook


def test_every_benchmark_is_in_the_table() -> None:
    assert "@@" not in README
    sources = "".join(path.read_text() for path in (ROOT / "benchmarks").glob("bench_*.py"))
    names = re.findall(r'Result\(\s*"([^"]+)"', sources)
    assert len(names) >= 10
    for name in names:
        assert f"| {name} |" in README
