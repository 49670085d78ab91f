"""Watches the served path and exchanges the model when there is another good one; a bad one changes nothing.

At the start, when the path has no good bundle, the last known good copy serves until it has. One sentence in log and
metrics says why the bundle at the path is not the one that serves, once for each reason.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from attentionvote.inference.errors import BundleError
from attentionvote.inference.server.json_logs import say
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.bundle_loading import BundleLoader, Mark, mark_of
from attentionvote.inference.server.model.serving import Served, Serving

T = TypeVar("T")
_FIRST_RETRY_S, _LAST_RETRY_S = 2.0, 300.0  # the same bundle again: disks get free, networks come back


class BundleWatch:
    """The task that keeps the model up to date.

    Args:
        source: the served path, a bundle's folder or a link to one.
        loader: makes models of folders.
        serving: gets them.
        metrics: is told what happened.
        poll_s: seconds between two looks.
        patience_s: how long the path may take at the start before the last known good copy serves meanwhile: a
            network folder whose server is down blocks.
    """

    def __init__(
        self,
        source: Path,
        loader: BundleLoader,
        serving: Serving,
        metrics: Metrics,
        poll_s: float = 2.0,
        patience_s: float = 10.0,
    ) -> None:
        self.problem: str | None = None
        # Asked why the path holds nothing yet, where somebody fills it and knows better.
        self.explain: Callable[[], str | None] = lambda: None
        self._source, self._loader, self._serving, self._metrics = source, loader, serving, metrics
        self._poll_s, self._patience_s = poll_s, patience_s
        self._save_failure: str | None = None
        self._tried: Mark | None = None
        self._retry_s, self._retry_at = _FIRST_RETRY_S, 0.0
        self._lock = asyncio.Lock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="reload")

    async def run(self) -> None:
        """Load the first model, then watch until cancelled."""
        first = asyncio.ensure_future(self._checked())
        done, _ = await asyncio.wait({first}, timeout=self._patience_s)
        if not done:
            self._tell(f"{self._source} does not answer within {self._patience_s:g} s: is the folder's server down?")
        if self._serving.current is None:
            await self._start_from_last_known_good()
        await first
        while True:
            await asyncio.sleep(self._poll_s)
            await self._checked()

    async def check(self) -> str | None:
        """Look at the path now, even if it was refused before, and say why it does not serve (None: it does)."""
        return await self._checked(forced=True)

    def close(self) -> None:
        """Begin nothing more; what runs ends by itself."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def _checked(self, forced: bool = False) -> str | None:
        """A look at the path that never raises: whatever happens, the model that serves goes on."""
        async with self._lock:
            try:
                await self._look(forced)
            except BundleError as error:
                self._failed("refused", str(error))
            except OSError as error:
                reason = error.strerror or str(error)
                self._failed("failed", f"{self._source} cannot be loaded and kept: {reason}; it is tried again")
            except Exception as error:  # ours to find, but the model that serves must go on
                reason = f"{type(error).__name__}: {error}"
                self._failed("failed", f"{self._source} cannot be loaded: {reason}; it is tried again", trace=True)
            return self.problem

    async def _look(self, forced: bool) -> None:
        mark = await self._blocking(mark_of, self._source)
        current, store = self._serving.current, self._loader.store
        due = forced or time.monotonic() >= self._retry_at
        if current is not None and not current.last_known_good and mark.digest == current.digest:
            self._tried = None
            self._serves()
            if current.saved or store is None:
                self._fine()
            elif due:
                await self._keep(current)
            return
        if mark == self._tried and not due:
            return
        if mark != self._tried:
            self._tried, self._retry_s = mark, _FIRST_RETRY_S
        # A model that serves is only replaced by one that could start the cell again.
        served, failure = await self._blocking(self._loader.from_source, self._source, must_keep=current is not None)
        self._metrics.reloads.labels("loaded").inc()
        self._serving.swap(served)
        self._fine()
        if failure is not None:
            self._save_failed(failure)

    async def _keep(self, current: Served) -> None:
        """Try again to keep what serves already."""
        try:
            done = await self._blocking(self._loader.keep, self._source, current.digest)
        except (OSError, BundleError) as error:
            self._save_failed(error)
        else:
            if done:
                self._serving.swap(dataclasses.replace(current, saved=True))
                self._fine()

    def _save_failed(self, error: Exception) -> None:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        self._later()
        if str(reason) != self._save_failure:
            self._save_failure = str(reason)
            sentence = f"the bundle serves but cannot be kept for the next start: {reason}; it is tried again"
            say("last_known_good", sentence, logging.ERROR)

    def _failed(self, outcome: str, sentence: str, trace: bool = False) -> None:
        self._metrics.reloads.labels(outcome).inc()
        self._later()
        self._tell(sentence, trace)

    async def _start_from_last_known_good(self) -> None:
        # Not in the reload thread, which may hang in the served path, nor in asyncio's, which is waited for at exit.
        thread = ThreadPoolExecutor(1, thread_name_prefix="last known good")
        try:
            served, problems = await asyncio.get_running_loop().run_in_executor(thread, self._loader.last_known_good)
        finally:
            thread.shutdown(wait=False)
        for problem in problems:
            say("last_known_good", f"a kept copy cannot serve: {problem}", logging.ERROR)
        if served is None:
            reason = self.explain() or self.problem
            self._serving.waits_for = f"{reason}, and there is no last known good copy to start from"
            say("waiting", self._serving.waits_for, logging.ERROR)
        elif self._serving.current is None:
            self._metrics.reloads.labels("last_known_good").inc()
            self._serving.swap(served)
        else:  # the path was quicker after all
            served.workers.close()

    def _later(self) -> None:
        """Try again after a while, each time a longer one."""
        self._retry_at = time.monotonic() + self._retry_s
        self._retry_s = min(2 * self._retry_s, _LAST_RETRY_S)

    def _fine(self) -> None:
        """The bundle at the path serves, and nothing is left to be tried again."""
        self._retry_s = _FIRST_RETRY_S
        self._save_failure = None
        self._serves()

    def _serves(self) -> None:
        """The bundle at the path is the one that serves, kept or not: ``last_known_good_kept`` tells which."""
        if self.problem is not None:
            say("reload", "the bundle at the served path serves, the problem is over")
        self.problem = None
        self._metrics.reload_problem(None)

    def _tell(self, sentence: str, trace: bool = False) -> None:
        """Say why the bundle at the path does not serve, once for each reason."""
        serves = self._serving.current
        if sentence != self.problem:
            stays = f"{serves.name} {serves.version} goes on serving" if serves else "nothing serves yet"
            say("reload", f"{sentence}; {stays}", logging.ERROR, trace=trace)
        self.problem = sentence
        self._metrics.reload_problem(sentence)
        if serves is None:
            self._serving.waits_for = self.explain() or sentence

    async def _blocking(self, work: Callable[..., T], *arguments: Any, **named: Any) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, lambda: work(*arguments, **named))
