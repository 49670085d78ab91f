"""The registered versions of one part's model: ``attentionvote-<part>`` in MLflow's registry.

A version's artefacts are a bundle's folder, and beside its files those by which MLflow itself loads it: a cell fetches
the files that the manifest names. The tag ``bundle.digest`` says which bundle it is. Aliases: ``candidate`` is the
version registered last, ``champion`` the one that cells follow.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attentionvote.inference import Bundle, BundleError, load_bundle
from attentionvote.inference.bundles.bundle import Trusted
from attentionvote.registry.gates import Origin
from attentionvote.registry.logged_model import DIGEST_TAG, Figures, log_model
from attentionvote.tracking.run_opening import PATCH, SESSION_TAG, session_folder
from attentionvote.tracking.server_check import check_health
from attentionvote.tracking.store import connect, experiment_id, is_server, resolve_store

if TYPE_CHECKING:
    from mlflow.entities.model_registry import ModelVersion

log = logging.getLogger(__name__)
PREFIX = "attentionvote-"
CHAMPION, CANDIDATE = "champion", "candidate"
UNMEASURED = Figures()


@dataclass(frozen=True)
class Version:
    """One registered version.

    Attributes:
        number: of the version.
        digest: of its bundle; empty when the version was not registered by us.
        run_id: of the training's run; empty when unknown.
        tags: all of them.
    """

    number: int
    digest: str
    run_id: str
    tags: Mapping[str, str] = field(default_factory=dict, repr=False)


class Versions:
    """The versions of a part's model in one store.

    Args:
        store: see :func:`attentionvote.tracking.store.resolve_store`.
        part: name of the part.

    Raises:
        ValueError: the store's URI is impossible or it cannot be used.
        ConnectionError: the server does not answer.
    """

    def __init__(self, store: str | None, part: str) -> None:
        self.uri = resolve_store(store)
        self.part = part
        self.name = PREFIX + part
        self.client = connect(self.uri)

    def all(self) -> list[Version]:
        """Every version that exists, oldest first; empty when nothing was ever registered."""
        return sorted(map(_version, self.rows(self.name)), key=lambda version: version.number)

    def rows(self, name: str) -> list[ModelVersion]:
        """Every version of a registered model as the store has it, in no particular order."""
        listed: list[ModelVersion] = []
        token = None
        while True:
            page = self.client.search_model_versions(f"name='{name}'", max_results=200, page_token=token)
            listed += page
            token = page.token
            if not token:
                return listed

    def champion(self) -> Version | None:
        """The version that cells follow; None before the first promotion, or when it was deleted."""
        from mlflow.exceptions import MlflowException

        try:
            return _version(self.client.get_model_version_by_alias(self.name, CHAMPION))
        except MlflowException as error:
            if error.error_code in ("INVALID_PARAMETER_VALUE", "RESOURCE_DOES_NOT_EXIST"):
                return None
            raise

    def of_bundle(self, digest: str) -> Version | None:
        """The newest version that is this bundle; None when it was never registered."""
        return next((version for version in reversed(self.all()) if version.digest == digest), None)

    def register(
        self, bundle: Bundle, tags: Mapping[str, str], figures: Figures = UNMEASURED, description: str = ""
    ) -> Version:
        """Upload a bundle, read it back, and make it a version; the same bundle is registered once.

        Args:
            bundle: verified.
            tags: of the version; of one that is there too.
            figures: that its logged model gets.
            description: of the version, Markdown; of one that is there too.

        Raises:
            OSError: when what the store gives back is not what it got.
        """
        registered = self.of_bundle(bundle.digest)
        if registered is not None and self._is_whole(registered):
            for name in registered.tags:
                if name.startswith("gate.") and name not in tags:  # of an earlier decision
                    self.client.delete_model_version_tag(self.name, str(registered.number), name)
            self.tag(registered, tags)
            if description:
                self.client.update_model_version(self.name, str(registered.number), description)
            return registered
        run = self._run(bundle.card.run_id)
        experiment = run.info.experiment_id if run else experiment_id(self.client, self.uri, self.part)
        facts = {DIGEST_TAG: bundle.digest, **tags}
        with self._global_store():
            model = log_model(self.client, experiment, bundle, run, figures, partial(self._check, bundle.digest))
            about = (
                f"6D pose models of {self.part}; moved by `make promote` and `make rollback`, see {self.name}-history"
            )
            self.create(self.name, {"part": self.part}, about)
            row = self.client.create_model_version(
                self.name,
                f"models:/{model.model_id}",
                run_id=run.info.run_id if run else None,
                tags=facts,
                description=description,
                model_id=model.model_id,
            )
            self.client.set_registered_model_alias(self.name, CANDIDATE, row.version)
        return _version(row)

    def fetch(self, version: Version, folder: Path, trusted: Trusted) -> Bundle:
        """Download a version's bundle into a folder and verify it: it must be what was registered.

        Raises:
            ValueError: when its artefacts are gone, not signed by the trusted key, or another bundle's.
        """
        location = self.client.get_model_version_download_uri(self.name, str(version.number))
        bundle = load_bundle(self._download(location, folder), trusted)
        if bundle.digest != version.digest or bundle.card.part.name != self.part:
            raise ValueError(
                f"version {version.number} of {self.name} must be bundle {version.digest[:12]} of {self.part}, but its "
                f"artefacts are bundle {bundle.digest[:12]} of {bundle.card.part.name}: delete that version"
            )
        return bundle

    def origin(self, run_id: str, signed_by: str) -> Origin:
        """What the store knows of the training that made a model.

        Args:
            run_id: as the model's card names it.
            signed_by: fingerprint of the key whose signature of the bundle was verified.
        """
        run = self._run(run_id)
        if run is None:
            return Origin(False, signed_by=signed_by)
        tags = run.data.tags
        try:
            numbers = sorted(int(name.removeprefix(SESSION_TAG)) for name in tags if name.startswith(SESSION_TAG))
            sessions = {number: json.loads(tags[f"{SESSION_TAG}{number}"]) for number in numbers}
            commits = tuple(str(session["commit"]) for session in sessions.values())
            dirty = {number: session["patch"] for number, session in sessions.items() if "+" in session["commit"]}
            whole = all(self._has_changes(run_id, number, digest) for number, digest in dirty.items())
        except (KeyError, TypeError, ValueError):  # not written by us
            commits, whole = (), False
        has_config = any(file.path == "config.yaml" for file in self.client.list_artifacts(run_id))
        return Origin(True, has_config, commits, whole, signed_by)

    def _has_changes(self, run_id: str, session: int, digest: str) -> bool:
        """Whether the patch of a session is there as it was written."""
        from mlflow.exceptions import MlflowException

        with tempfile.TemporaryDirectory(prefix="attentionvote-") as folder:
            try:
                path = Path(self.client.download_artifacts(run_id, session_folder(session) + PATCH, folder))
            except (MlflowException, OSError):
                return False
            return bool(digest) and hashlib.sha256(path.read_bytes()).hexdigest() == digest

    def set_champion(self, version: Version) -> None:
        """Move the alias; cells follow within their polling time."""
        self.client.set_registered_model_alias(self.name, CHAMPION, str(version.number))

    def tag(self, version: Version, tags: Mapping[str, str]) -> None:
        """Set tags of a version."""
        for name, value in tags.items():
            self.client.set_model_version_tag(self.name, str(version.number), name, value)

    def create(self, name: str, tags: Mapping[str, str], about: str) -> None:
        """Make a registered model, unless it is there."""
        from mlflow.exceptions import MlflowException

        try:
            self.client.create_registered_model(name, tags=dict(tags), description=about)
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise

    def has_run(self, run_id: str) -> bool:
        """Whether the store has the run of a training."""
        return self._run(run_id) is not None

    def _run(self, run_id: str) -> Any:
        """The run of an id, or None when the store does not have it."""
        from mlflow.exceptions import MlflowException

        if not run_id:
            return None
        try:
            return self.client.get_run(run_id)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                raise  # a store that is away or refuses says nothing about the run
            return None

    def _is_whole(self, version: Version) -> bool:
        """Whether a version's artefacts are still the bundle it was registered as."""
        location = self.client.get_model_version_download_uri(self.name, str(version.number))
        try:
            self._check(version.digest, location)
        except (OSError, ValueError) as error:
            log.warning("version %d is registered anew: %s", version.number, error)
            return False
        return True

    def _check(self, digest: str, location: str) -> None:
        """What was stored must be the bundle, bit by bit: a proxy, a full disk or another version may interfere."""
        try:
            with tempfile.TemporaryDirectory(prefix="attentionvote-") as folder:
                stored = load_bundle(self._download(location, Path(folder)), None)
        except BundleError as error:
            raise OSError(f"the registry must give back the bundle it got, but {error}") from error
        if stored.digest != digest:
            raise OSError(f"the registry must give back bundle {digest[:12]}, but it gave {stored.digest[:12]}")

    def _download(self, location: str, folder: Path) -> Path:
        from mlflow.artifacts import download_artifacts
        from mlflow.exceptions import MlflowException

        try:
            return Path(download_artifacts(artifact_uri=location, dst_path=str(folder), tracking_uri=self.uri))
        except (MlflowException, OSError) as error:
            if is_server(self.uri):
                check_health(self.uri)
            reason = str(error).strip().split("\n")[0]
            raise ValueError(
                f"the artefacts of {self.name} must be in the store, but they are not: {reason}"
            ) from error

    @contextlib.contextmanager
    def _global_store(self) -> Iterator[None]:
        """MLflow's SQL registry looks logged models up in the global tracking store, whatever its client says."""
        import mlflow

        before, variable = mlflow.get_tracking_uri(), os.environ.get("MLFLOW_TRACKING_URI")
        mlflow.set_tracking_uri(self.uri)
        try:
            yield
        finally:
            mlflow.set_tracking_uri(before)
            if variable is None:  # it sets the variable too
                os.environ.pop("MLFLOW_TRACKING_URI", None)


def _version(row: ModelVersion) -> Version:
    tags = dict(row.tags)
    return Version(int(row.version), tags.get(DIGEST_TAG, ""), row.run_id or "", tags)


DATA_FACT = "data."  # and the split: digest of the scenes that a version was trained with, among its tags
