"""An installed wheel is enough: it carries the firmware's image and the compiled twin."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]

_CAPTURE = """
import twin.link, acquisition.cli, sys
assert twin.link.__file__.startswith(sys.argv[1]), twin.link.__file__
assert str(twin.link.firmware_image()).startswith(sys.argv[1])
acquisition.cli.main(["capture", "--link", "twin", "-n", "1", "-o", "one", "--quiet"])
"""


def test_wheel_captures_with_the_twin(tmp_path: Path) -> None:
    # from a copy of what git has: a wheel must not depend on what was built here before
    source = tmp_path / "source"
    files = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    for name in filter(None, files.split("\0")):
        if (ROOT / name).is_file():
            target = source / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    build = [
        sys.executable,
        "-m",
        "uv",
        "build",
        "--wheel",
        "--quiet",
        "-o",
        str(tmp_path),
        str(source),
    ]
    subprocess.run(build, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    for machine in ("x86_64", "aarch64"):
        assert f"twin/core/build/libtwin-{machine}.so" in names
    assert {"tracking/cli.py", "twin/data/walk.toml"} <= set(names)
    assert not any(name.startswith(("tests/", "notebooks/")) for name in names)
    installed = tmp_path / "installed"
    zipfile.ZipFile(wheel).extractall(installed)
    subprocess.run(
        [sys.executable, "-c", _CAPTURE, str(installed)],
        check=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(installed)},
    )
    assert (tmp_path / "one00001.dat").is_file()
