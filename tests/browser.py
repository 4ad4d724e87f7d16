"""A real browser for the tests of pages."""

import atexit
import functools
import json
import os
import select
import shutil
import subprocess
import time

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class _Chromium:
    """A headless Chromium, spoken to by the DevTools protocol over a pipe: one for all pages of a process."""

    def __init__(self):
        to_read, self._to = os.pipe()
        self._from, to_write = os.pipe()
        command = (
            f'exec "{CHROMIUM}" --headless=new --no-sandbox --disable-gpu --disable-dev-shm-usage '
            f"--remote-debugging-pipe --no-first-run --disable-background-networking 3<&{to_read} 4>&{to_write}"
        )
        self._process = subprocess.Popen(
            ["bash", "-c", command],
            pass_fds=(to_read, to_write),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(to_write)
        self._number, self._rest = 0, b""
        atexit.register(self._end)

    def send(self, method, session, events, **parameters):
        """Send a command to the page of a session (None: to the browser), and return its result; events are added."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            while b"\0" not in self._rest:
                if not select.select([self._from], [], [], max(0, deadline - time.monotonic()))[0]:
                    raise TimeoutError(method)
                read = os.read(self._from, 1 << 20)
                if not read:
                    _chromium.cache_clear()  # the next test has another one
                    raise AssertionError("the browser is gone")
                self._rest += read
            text, self._rest = self._rest.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            if "method" in answer and answer.get("sessionId") == session:
                events.append(answer)
        raise TimeoutError(method)

    def _end(self):
        self._process.terminate()
        self._process.wait()
        os.close(self._to)
        os.close(self._from)


_chromium = functools.cache(_Chromium)


class Browser:
    """A browser with one page open, which shares nothing with another one: no storage, no cache."""

    def __init__(self, url):
        self._session = None
        self.events = []
        self._context = self.send("Target.createBrowserContext")["browserContextId"]
        target = self.send("Target.createTarget", url="about:blank", browserContextId=self._context)["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.size(1280, 900)
        self.send("Page.navigate", url=url)
        self.wait("document.readyState === 'complete' && !!document.getElementById('clock').textContent")

    def send(self, method, **parameters):
        return _chromium().send(method, self._session, self.events, **parameters)

    def run(self, expression):
        answer = self.send(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True, userGesture=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, expression, seconds=120):
        deadline = time.monotonic() + seconds
        while not self.run(expression):
            assert time.monotonic() < deadline, expression
            time.sleep(0.05)

    def size(self, width, height, mobile=False):
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=mobile)

    def key(self, key, code=None):
        for kind in ("keyDown", "keyUp"):
            text = {"text": key} if len(key) == 1 and kind == "keyDown" else {}
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=code or key, **text)

    def touch(self, x, y):
        self.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def complaints(self, own="file:"):
        """Errors of the page, and whatever it tried to load from elsewhere."""
        found = []
        for event in self.events:
            method, details = event["method"], event["params"]
            if method == "Runtime.exceptionThrown":
                found.append(details["exceptionDetails"])
            elif method == "Log.entryAdded" and details["entry"]["level"] in ("error", "warning"):
                found.append(details["entry"])
            elif method == "Runtime.consoleAPICalled" and details["type"] in ("error", "warning", "assert"):
                found.append(details)
            elif method == "Network.requestWillBeSent":
                url = details["request"]["url"]
                if not url.startswith((own, "data:")):
                    found.append(url)
        return found

    def close(self):
        self._session = None
        self.send("Target.disposeBrowserContext", browserContextId=self._context)
