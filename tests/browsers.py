"""A real browser for tests: chromium and its driver, both from the system's packages."""

import base64
import contextlib
import shutil
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

WIDTHS = (390, 1280)
HEIGHT = 900
PATIENCE = 600
"""On a machine that is busy with other tests, unit second."""

IMAGES = """return [...document.images].filter(i => !(i.complete && i.naturalWidth > 0
  && i.getBoundingClientRect().width > 0)).map(i => i.alt || i.src.slice(0, 40))"""
HIDDEN = "return [...document.querySelectorAll('details')].map(d => d.open = true).length"
LINKS = """return [...document.links].map(a => a.getAttribute('href')).filter(h =>
  h.startsWith('#') ? !document.getElementById(decodeURIComponent(h.slice(1)))
                    : !h.startsWith('data:text/csv;'))"""
SIDEWAYS = """const d = document.documentElement;
return [d.clientWidth, Math.max(d.scrollWidth, document.body.scrollWidth)]"""


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[webdriver.Chrome]:
    """A browser without a window, whose downloads go to `folder`; skips where there is none."""
    program, driver = (
        next(filter(None, map(shutil.which, names)), None)
        for names in (("chromium", "google-chrome"), ("chromedriver",))
    )
    if program is None or driver is None:
        missing = "chromium" if program is None else "chromedriver"
        pytest.skip(f"no {missing}: apt-get install chromium chromium-driver to test pages in it")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.add_argument(f"--user-data-dir={folder / 'profile'}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    options.timeouts = {"pageLoad": 1000 * PATIENCE, "script": 1000 * PATIENCE}
    opened = webdriver.Chrome(options=options, service=Service(executable_path=driver))
    opened.command_executor.client_config.timeout = PATIENCE
    try:
        opened.execute_cdp_cmd(
            "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)}
        )
        yield opened
    finally:
        opened.quit()


def open_page(driver: webdriver.Chrome, page: Path | str, width: int) -> None:
    """Open a file or an address as a phone or a screen of that width would."""
    size = {"width": width, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.get(page.as_uri() if isinstance(page, Path) else page)


def console(driver: webdriver.Chrome) -> list[str]:
    """Errors and warnings of the page since it was asked last."""
    said = driver.get_log("browser")
    return [entry["message"] for entry in said if entry["level"] not in ("INFO", "DEBUG")]


def sideways(driver: webdriver.Chrome) -> tuple[int, int]:
    """Width of the window, and the width that the page needs; unit pixel."""
    room, needed = driver.execute_script(SIDEWAYS)
    return room, needed


def faults(driver: webdriver.Chrome) -> list[str]:
    """List what is wrong with the page that is open; empty if nothing is."""
    found = [f"console: {said}" for said in console(driver)]
    driver.execute_script(HIDDEN)
    found += [f"no picture: {name}" for name in driver.execute_script(IMAGES)]
    folder = Path(urllib.parse.unquote(urllib.parse.urlsplit(driver.current_url).path)).parent
    dead = (x for x in driver.execute_script(LINKS) if x[0] == "#" or not (folder / x).is_file())
    found += [f"dead link: {address}" for address in dead]
    room, needed = sideways(driver)
    return found + ([f"scrolls sideways: {needed} in {room}"] if needed > room else [])


def printed(driver: webdriver.Chrome) -> bytes:
    """The page as it would be printed, on A4."""
    paper = {"paperWidth": 8.27, "paperHeight": 11.69, "printBackground": True}
    return base64.b64decode(driver.execute_cdp_cmd("Page.printToPDF", paper)["data"])
