"""The source of a server's model: a path, or a model in a registry that is fetched into the state folder."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from attentionvote.inference.errors import InputError
from attentionvote.inference.fetching import access as registry_access
from attentionvote.inference.fetching.access import Access
from attentionvote.inference.fetching.bundles import FetchedBundles
from attentionvote.inference.fetching.reference import Reference, is_reference, parse_reference
from attentionvote.inference.fetching.registry import Registry
from attentionvote.inference.server.access import is_loopback
from attentionvote.inference.server.metrics import Metrics
from attentionvote.inference.server.model.bundle_loading import BundleLoader
from attentionvote.inference.server.model.following import Following, Watch
from attentionvote.inference.server.model.reloading import BundleWatch
from attentionvote.inference.server.model.serving import Serving


@dataclass(frozen=True)
class Source:
    """What the options name, checked; nothing is asked of a registry yet.

    Attributes:
        name: as it was given: the path, or the reference.
        access: to the registry; None for a path.
    """

    name: Path | Reference
    access: Access | None = None

    @property
    def warnings(self) -> list[str]:
        """What an operator should know about the credentials."""
        warnings = []
        if self.access is not None and self.access.readable_by_others:
            warnings.append("the registry's credentials can be read by everybody on this machine: chmod 600 their file")
        if self.access is not None and self.access.open_to_listeners and not is_loopback(self.access.host):
            warnings.append("the registry's password crosses the network unencrypted: give --registry an https address")
        return warnings

    def bundles(self, state: Path, key: Ed25519PublicKey) -> FetchedBundles | None:
        """The fetched bundles below the state folder, their link on the newest one of this reference; None for a path.

        The state folder must be this server's already.

        Raises:
            InputError: when the folder cannot be written.
        """
        if not isinstance(self.name, Reference):
            return None
        folder = state / "registry"
        try:
            bundles = FetchedBundles(folder, self.name, key)
            bundles.restore()
        except OSError as error:
            raise InputError(
                f"{self.name} needs a state folder to fetch bundles into, but {folder} cannot be written "
                f"({error.strerror}): name another with --state"
            ) from error
        return bundles

    def watch(
        self,
        bundles: FetchedBundles | None,
        loader: BundleLoader,
        serving: Serving,
        metrics: Metrics,
        poll_s: float,
        registry_poll_s: float,
    ) -> Watch:
        """What keeps the model up to date."""
        if isinstance(self.name, Path):
            return BundleWatch(self.name, loader, serving, metrics, poll_s)
        assert bundles is not None
        assert self.access is not None
        watch = BundleWatch(bundles.link, loader, serving, metrics, poll_s)
        return Following(Registry(self.access), bundles, watch, serving, metrics, registry_poll_s)


def source_of(options: argparse.Namespace) -> Source:
    """The source that ``serve``'s options name.

    Raises:
        InputError: when it cannot be one.
    """
    if is_reference(options.bundle):
        reference = parse_reference(options.bundle)
        return Source(reference, registry_access.access(options))
    if options.registry is not None or options.registry_auth_file is not None:
        raise InputError(
            f"--registry and --registry-auth-file belong to models:/NAME@ALIAS or models:/NAME/VERSION, got the path "
            f"{options.bundle}"
        )
    return Source(Path(options.bundle))
