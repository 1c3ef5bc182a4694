"""A real JupyterLab, driven in headless Chromium by Playwright.

Chromium is not on PyPI: ``apt install chromium``.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Self

from playwright.sync_api import sync_playwright

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

READY = 120_000
"""How long to wait for JupyterLab or a kernel, ms."""


def chromium() -> str | None:
    """Path of an installed Chromium, or None."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


class Lab:
    """A context: JupyterLab on a folder, and a page on which it is open.

    Parameters
    ----------
    folder : Path
        What JupyterLab shows; its notebooks may be changed.
    """

    page: Page

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._settings = Path(tempfile.mkdtemp(prefix="lab-"))

    def __enter__(self) -> Self:
        path = chromium()
        if path is None:
            raise RuntimeError("no Chromium found: apt install chromium")
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._url = f"http://127.0.0.1:{probe.getsockname()[1]}"
        self._log = (self._settings / "log").open("w", encoding="utf-8")
        self._server = subprocess.Popen(
            [
                sys.executable,
                *("-m", "jupyterlab", "--no-browser", "--allow-root"),
                f"--ServerApp.port={self._url.rpartition(':')[2]}",
                "--ServerApp.port_retries=0",
                f"--ServerApp.root_dir={self._folder}",
                "--IdentityProvider.token=",
                "--LabApp.expose_app_in_browser=True",
            ],
            env={**os.environ, **self._private_settings()},
            stdout=subprocess.DEVNULL,
            stderr=self._log,
        )
        self._playwright = sync_playwright().start()
        try:
            self._wait_for_server()
            self._browser = self._playwright.chromium.launch(
                executable_path=path, args=["--no-sandbox", "--disable-gpu"]
            )
            self.page = self._browser.new_page(viewport={"width": 1400, "height": 1000})
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._playwright.stop()
        self._server.terminate()
        self._server.wait(timeout=30)
        self._log.close()
        shutil.rmtree(self._settings, ignore_errors=True)

    def run_all(self, notebook: str) -> None:
        """Open a notebook, run all of its cells, and wait until the kernel is idle again."""
        self.page.goto(f"{self._url}/lab/tree/{notebook}")
        self.page.wait_for_function(
            "() => window.jupyterapp?.shell.currentWidget?.sessionContext?.session?.kernel"
            "?.status === 'idle'",
            timeout=READY,
        )
        self.page.evaluate("() => window.jupyterapp.commands.execute('notebook:run-all-cells')")
        self.page.wait_for_function(
            "() => {const w = window.jupyterapp.shell.currentWidget;"
            " const cells = w.content.widgets.filter(c => c.model.type === 'code');"
            " return w.sessionContext.session.kernel.status === 'idle'"
            " && cells.every(c => c.model.executionCount && !c.node.querySelector("
            "'.jp-InputPrompt').textContent.includes('*'));}",
            timeout=READY,
        )

    def slider(self, description: str) -> Locator:
        """Return the handle of the slider with this description, to be focused and pressed."""
        row = self.page.locator(".widget-slider", has_text=description).first
        return row.locator(".noUi-handle").first

    def _private_settings(self) -> dict[str, str]:
        """Keep the user's settings out, and news and updates from covering the page."""
        overrides = self._settings / "lab" / "@jupyterlab" / "apputils-extension"
        overrides.mkdir(parents=True)
        (overrides / "notification.jupyterlab-settings").write_text(
            '{"fetchNews": "false", "checkForUpdates": false}', encoding="utf-8"
        )
        return {
            "JUPYTERLAB_SETTINGS_DIR": str(self._settings / "lab"),
            "JUPYTERLAB_WORKSPACES_DIR": str(self._settings / "workspaces"),
            "JUPYTER_CONFIG_DIR": str(self._settings / "config"),
            "JUPYTER_RUNTIME_DIR": str(self._settings / "runtime"),
            "IPYTHONDIR": str(self._settings / "ipython"),
        }

    def _wait_for_server(self) -> None:
        for _ in range(READY // 200):
            if self._server.poll() is not None:
                break
            try:
                urllib.request.urlopen(f"{self._url}/api", timeout=5).close()  # noqa: S310, our own
            except OSError:
                time.sleep(0.2)
            else:
                return
        log = (self._settings / "log").read_text(encoding="utf-8")
        raise RuntimeError(f"JupyterLab did not start:\n{log[-2000:]}")
