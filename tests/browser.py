# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium that resolves no host name, and what it tells of a page."""

from collections.abc import Iterator
import json
import shutil
from typing import Any

import pytest


def headless() -> Iterator[Any]:
    """Yield the browser, or skip the test where there is none."""
    webdriver = pytest.importorskip('selenium.webdriver')
    chromium = shutil.which('chromium') or shutil.which('chromium-browser')
    driver = shutil.which('chromedriver')
    if not (chromium and driver):
        pytest.skip('needs chromium and chromedriver: apt install chromium chromium-driver')
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in (
        '--headless=new',
        '--no-sandbox',
        '--disable-gpu',
        '--disable-dev-shm-usage',
        '--window-size=1250,1000',
        '--host-resolver-rules=MAP * ~NOTFOUND',
    ):
        options.add_argument(argument)
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL', 'performance': 'ALL'})
    service = webdriver.ChromeService(executable_path=driver)
    found = webdriver.Chrome(options=options, service=service)
    yield found
    found.quit()


def requested(browser: Any) -> set[str]:
    """Return the addresses that pages asked for since the last call."""
    found = set()
    for entry in browser.get_log('performance'):
        message = json.loads(entry['message'])['message']
        if message['method'] == 'Network.requestWillBeSent':
            found.add(message['params']['request']['url'])
    return found


def problems(browser: Any) -> list[Any]:
    """Return the errors in the console since the last call."""
    return [entry for entry in browser.get_log('browser') if entry['level'] == 'SEVERE']
