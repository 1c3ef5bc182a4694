"""Build hook: a wheel carries the firmware's image and the twin's event loop for both machines."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ZIG = "ziglang==0.16.0"
IMAGE = "F401_FW_TCD1304"


class Binaries(BuildHookInterface):  # type: ignore[type-arg]
    """Compiles with zig, which needs no root and crosses to both machines."""

    def dependencies(self) -> list[str]:
        """Compiler and the emulator's headers; an editable install has its own (`make setup`)."""
        return [] if self.target_name != "wheel" else [ZIG, "unicorn>=2.1.4"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build into the source tree and add the results to the wheel."""
        if self.target_name != "wheel" or version == "editable":
            return
        root = Path(self.root)
        zig = f"{sys.executable} -m ziglang cc"
        make = ["make", "-B", "-C"]  # whatever was built here before is for this machine
        subprocess.run([*make, root / "firmware", f"ZIG={sys.executable} -m ziglang"], check=True)
        for machine in ("x86_64", "aarch64"):
            compiler = f"CC={zig} -target {machine}-linux-gnu.2.28"
            arguments = [compiler, f"MACHINE={machine}", f"PYTHON={sys.executable}"]
            subprocess.run([*make, root / "twin" / "core", *arguments], check=True)
            library = f"twin/core/build/libtwin-{machine}.so"
            build_data["force_include"][str(root / library)] = library
        for suffix in ("elf", "bin"):
            image = root / "firmware" / "build" / f"{IMAGE}.{suffix}"
            build_data["force_include"][str(image)] = f"twin/{IMAGE}.{suffix}"
