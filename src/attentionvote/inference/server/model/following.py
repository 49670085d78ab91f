"""Follows a model in a registry: asks which version serves, fetches it, and moves the link that a watch looks at.

The watch does the rest, as for any other path. What the registry does not answer, or answers badly, never changes what
serves; one sentence in log and metrics says why, once for each reason.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import random
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TypeAlias

from attentionvote.inference.errors import BundleError, RegistryError
from attentionvote.inference.fetching.bundles import DIGITS, FetchedBundles
from attentionvote.inference.fetching.reference import RegistryVersion
from attentionvote.inference.fetching.registry import Registry
from attentionvote.inference.server.json_logs import say
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.reloading import BundleWatch
from attentionvote.inference.server.model.serving import Serving
from attentionvote.inference.server.priority import be_polite

_LONGEST_AWAY_S, _LONGEST_RETRY_S = 60.0, 300.0
_SLOW_S = 60.0  # a step that lasts longer is said to: each of a bundle's files may take half a minute and more
_MOST_REPORTED = 100
# Cells that were switched on together, or lost their registry together, must not ask in one voice.
_JITTER = 0.2


class Following:
    """The task that keeps the link up to date, and the bundle's watch beside it.

    Args:
        registry: is asked.
        bundles: get what it names.
        watch: watches their link.
        serving: is told which version it is that serves.
        metrics: are told what happened.
        poll_s: seconds between two questions.
        patience_s: how long the registry may take at the start while there is nothing else to serve.
    """

    def __init__(
        self,
        registry: Registry,
        bundles: FetchedBundles,
        watch: BundleWatch,
        serving: Serving,
        metrics: Metrics,
        poll_s: float = 10.0,
        patience_s: float = 30.0,
    ) -> None:
        self._registry, self._bundles, self._watch = registry, bundles, watch
        self._serving, self._metrics = serving, metrics
        self._poll_s, self._patience_s = poll_s, patience_s
        self._registry_problem: str | None = None
        self._reported: set[str] = set()
        self._away_s = poll_s
        self._refused: RegistryVersion | None = None
        self._refusal: Exception | None = None
        self._retry_s, self._retry_at = poll_s, 0.0
        self._watching = False
        self._lock = asyncio.Lock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="registry", initializer=be_polite)
        watch.explain = lambda: self._registry_problem

    @property
    def problem(self) -> str | None:
        """Why what the registry names does not serve; None: it does, as far as is known."""
        return self._registry_problem or self._watch.problem

    async def run(self) -> None:
        """Follow until cancelled."""
        first = asyncio.ensure_future(self._step())
        try:
            if not self._bundles.link.is_dir():  # a first start: a moment later there may be a bundle
                await asyncio.wait({first}, timeout=self._patience_s)
            self._watching = True
            await asyncio.gather(self._watch.run(), self._follow(first))
        finally:
            first.cancel()

    async def check(self) -> str | None:
        """Ask now, look at the link now, and say why it does not serve (None: it does)."""
        self._retry_at = 0.0
        await self._step()
        await self._watch.check()
        return self.problem

    def close(self) -> None:
        """Begin nothing more; what is being fetched ends at its next bytes."""
        self._registry.close()
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._watch.close()

    async def _follow(self, first: asyncio.Future[float]) -> None:
        wait_s = await first
        while True:
            await asyncio.sleep(wait_s * random.uniform(1 - _JITTER, 1 + _JITTER))
            wait_s = await self._step()

    async def _step(self) -> float:
        """One question that never raises; how long to wait before the next one, seconds."""
        async with self._lock:
            try:
                moved = await self._asked()
            except RegistryError as error:
                return self._failed("away" if error.away else "refused", str(error))
            except BundleError as error:
                return self._failed("refused", f"{self._bundles.reference} cannot be taken up: {error}")
            except OSError as error:
                reason = error.strerror or str(error)
                return self._failed("failed", f"{self._bundles.folder} cannot be written: {reason}; it is tried again")
            except Exception as error:  # ours to find, but the model that serves must go on
                reason = f"{type(error).__name__}: {error}"
                return self._failed("failed", f"{self._bundles.reference} cannot be followed: {reason}", trace=True)
            self._fine()
        if moved and self._watching:
            await self._watch.check()
        self._name_what_serves()
        return self._poll_s

    async def _asked(self) -> bool:
        """Whether the link was moved; a question that lasts long is a problem before it has ended."""
        work = asyncio.get_running_loop().run_in_executor(self._thread, self._ask, self._served_digests())
        try:
            done, _ = await asyncio.wait({work}, timeout=_SLOW_S)
            if not done:
                self._tell(
                    f"{self._bundles.reference} has been asked for or fetched for {_SLOW_S:g} s, and it is not over"
                )
            return await work
        except asyncio.CancelledError:
            work.cancel()
            raise

    def _failed(self, outcome: str, sentence: str, trace: bool = False) -> float:
        """Count and say a failure; how long to wait, seconds."""
        self._metrics.registry_polls.labels(outcome).inc()
        self._tell(sentence, trace)
        if outcome != "away":
            self._away_s = self._poll_s
            return self._poll_s
        wait_s, self._away_s = self._away_s, min(2 * self._away_s, max(_LONGEST_AWAY_S, self._poll_s))
        return wait_s

    def _tell(self, sentence: str, trace: bool = False) -> None:
        """Say why the registry's model does not serve, once for each reason."""
        self._metrics.registry_problem(sentence)
        serves = self._serving.current
        if sentence not in self._reported:
            stays = f"{serves.name} {serves.version} goes on serving" if serves else "nothing serves yet"
            say("registry", f"{sentence}; {stays}", logging.ERROR, trace=trace)
        if len(self._reported) < _MOST_REPORTED:
            self._reported.add(sentence)
        self._registry_problem = sentence
        if serves is None:
            self._serving.waits_for = sentence

    def _fine(self) -> None:
        """The link leads to what the registry names."""
        self._metrics.registry_polls.labels("answered").inc()
        self._metrics.registry_problem(None)
        if self._registry_problem is not None:
            say("registry", f"{self._bundles.reference} can be followed, the problem is over")
        self._registry_problem, self._away_s = None, self._poll_s
        self._reported.clear()

    def _served_digests(self) -> frozenset[str]:
        current = self._serving.current
        return frozenset() if current is None else frozenset({current.digest})

    def _ask(self, serving: frozenset[str]) -> bool:
        """Whether the link was moved. Blocking; in the thread."""
        before = self._bundles.target()
        if self._bundles.pinned() is not None:
            return False  # a pin that is here needs no registry
        version = self._registry.resolve(self._bundles.reference)
        if version != self._refused:
            self._refused, self._refusal, self._retry_s = version, None, self._poll_s
        elif self._refusal is not None and time.monotonic() < self._retry_at:
            raise self._refusal.with_traceback(None)  # known already, and not fetched again so soon
        try:
            folder, fetched = self._bundles.take(self._registry, version, serving)
        except RegistryError:
            raise
        except (BundleError, OSError) as error:
            self._refusal, self._retry_at = error, time.monotonic() + self._retry_s
            self._retry_s = min(2 * self._retry_s, _LONGEST_RETRY_S)
            raise
        self._refused = None
        moved = self._bundles.target() != before
        if fetched or moved:
            say(
                "registry", f"{self._bundles.reference} is {version}, bundle {version.digest[:DIGITS]}",
                model=version.name, model_version=version.version, digest=version.digest, fetched=fetched,
                folder=str(folder),
            )  # fmt: skip
        return moved

    def _name_what_serves(self) -> None:
        """The same bundle may be another version by now."""
        current = self._serving.current
        if current is not None:
            origin = self._bundles.origin_of(current.digest)
            if origin != current.origin:
                self._serving.swap(dataclasses.replace(current, origin=origin))


Watch: TypeAlias = BundleWatch | Following  # what keeps the model up to date
