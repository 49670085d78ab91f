"""Asks an MLflow registry over plain HTTP which bundle to serve, and reads its files. No mlflow package.

Three questions suffice: which version an alias names, which bundle a version is, and one file of a version. Every
answer is bounded in size and time; no proxy is asked and no redirect to another host is followed, so that the
credentials reach the registry only.
"""

from __future__ import annotations

import difflib
import http.client
import json
import re
import ssl
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Generator, Iterable
from contextlib import closing
from typing import IO, Any

from attentionvote.inference.errors import BundleError, RegistryError
from attentionvote.inference.fetching.access import Access
from attentionvote.inference.fetching.bounded_http import Exchange, handlers
from attentionvote.inference.fetching.reference import Reference, RegistryVersion

DIGEST_TAG = "bundle.digest"
_API = "/api/2.0/mlflow/"
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MOST_JSON_BYTES, _MOST_ERROR_BYTES = 4 * 1024 * 1024, 64 * 1024
_CHUNK_BYTES = 256 * 1024
# An exchange may take this long and what its size adds: one that drips byte by byte must not hold the cell for ever.
_LONGEST_ANSWER_S, _SLOWEST_BYTES_PER_S = 30.0, 64 * 1024
_MOST_NAMED = 8


class _Absent(Exception):
    """The registry answers that it does not have what was asked for."""


class _SameHost(urllib.request.HTTPRedirectHandler):
    """Follows redirects within the registry: whoever it sends us to elsewhere must not get the credentials."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        before, after = (urllib.parse.urlsplit(url) for url in (req.full_url, newurl))
        if (before.scheme, before.netloc) != (after.scheme, after.netloc):
            fp.close()
            raise RegistryError(
                f"the registry {before.scheme}://{before.netloc} redirects to another address, "
                f"{after.scheme}://{after.hostname}, which is not followed: give --registry the right one"
            )
        return super().redirect_request(req, fp, code, msg, headers, newurl)


class Registry:
    """One MLflow server.

    Args:
        access: its address, and who asks.
        timeout_s: longest wait for a connection and for the next bytes; an exchange as a whole is bounded as well.
    """

    def __init__(self, access: Access, timeout_s: float = 10.0) -> None:
        self.url = access.url
        self._timeout_s = timeout_s
        self._headers = {"Accept-Encoding": "identity", "User-Agent": "attentionvote"}
        if access.authorization is not None:
            self._headers["Authorization"] = access.authorization
        self._tls = ssl.create_default_context()
        self._closed = threading.Event()

    def close(self) -> None:
        """End what is being read in other threads at its next bytes."""
        self._closed.set()

    def resolve(self, reference: Reference) -> RegistryVersion:
        """The version that a reference names now.

        Raises:
            RegistryError: when the registry is away, refuses, or has no such model, alias or version.
            BundleError: when the version is not one of ours.
        """
        try:
            if reference.alias is not None:
                query = {"name": reference.name, "alias": reference.alias}
                content = self._json("registered-models/alias", query)
            else:
                content = self._json("model-versions/get", {"name": reference.name, "version": reference.version or ""})
        except _Absent:
            raise RegistryError(self._absent(reference)) from None
        try:
            entry = content["model_version"]
            name, version = str(entry["name"]), str(entry["version"])
            tags = {str(tag["key"]): str(tag.get("value", "")) for tag in entry.get("tags", [])}
        except (KeyError, TypeError, AttributeError) as error:
            raise RegistryError(self._no_registry()) from error
        if name != reference.name or reference.version not in (None, version):
            raise RegistryError(
                f"the registry {self.url} must answer {reference}, got version {version[:20]} of {name[:80]}"
            )
        digest = tags.get(DIGEST_TAG, "")
        if not _DIGEST.fullmatch(digest) or not re.fullmatch(r"[1-9][0-9]{0,8}", version):
            raise BundleError(
                f"version {version[:20]} of {name} must have the tag {DIGEST_TAG} with its bundle's sha256, "
                f"got {digest[:80]!r}: register it with `make promote`"
            )
        return RegistryVersion(name, version, digest)

    def pieces(self, version: RegistryVersion, name: str, most: int) -> Generator[bytes, None, None]:
        """A file of a version, piece by piece.

        Args:
            version: that holds it.
            name: of the file, relative to the bundle.
            most: bytes; not more are read.

        Raises:
            BundleError: when the version has no such file, or it is larger.
            RegistryError: when the registry is away or refuses.
        """
        query = {"name": version.name, "version": version.version, "path": name}
        longest_s = _LONGEST_ANSWER_S + most / _SLOWEST_BYTES_PER_S
        try:
            yield from self._get("/model-versions/get-artifact", query, most, longest_s)
        except _Absent:
            raise BundleError(
                f"{version} must hold {name}, but there is none: register a bundle with `make promote`"
            ) from None
        except OverflowError:
            raise BundleError(f"{version}: {name} must have at most {most} bytes, got more: is it a bundle?") from None

    def _json(self, question: str, query: dict[str, str]) -> Any:
        try:
            content = b"".join(self._get(_API + question, query, _MOST_JSON_BYTES, _LONGEST_ANSWER_S))
        except OverflowError:
            content = b""
        try:
            return json.loads(content)
        except (ValueError, RecursionError):
            raise RegistryError(self._no_registry()) from None

    def _no_registry(self, got: str = "another kind of answer") -> str:
        return f"the registry {self.url} must be an MLflow server, got {got}"

    def _get(self, path: str, query: dict[str, str], most: int, longest_s: float) -> Generator[bytes, None, None]:
        """One answer, piece by piece.

        Raises:
            RegistryError: away or refused.
            _Absent: the registry says that there is no such thing.
            OverflowError: more than ``most`` bytes.
        """
        exchange = Exchange(time.monotonic() + longest_s, self._timeout_s, self._closed)
        opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), *handlers(exchange, self._tls), _SameHost()
        )
        request = urllib.request.Request(f"{self.url}{path}?{urllib.parse.urlencode(query)}", headers=self._headers)
        try:
            with closing(opener.open(request)) as response:
                count = 0
                while piece := response.read1(_CHUNK_BYTES):
                    count += len(piece)
                    if count > most:
                        raise OverflowError
                    yield piece
                if response.length:  # what its header promised and did not come
                    raise http.client.IncompleteRead(b"", response.length)
        except urllib.error.HTTPError as error:
            with closing(error):
                self._refuse(error)
        except http.client.IncompleteRead:
            raise RegistryError(f"the registry {self.url} ended an answer before it was whole", away=True) from None
        except (OSError, http.client.HTTPException) as error:
            raise RegistryError(f"the registry {self.url} cannot be reached: {_reason(error)}", away=True) from error

    def _refuse(self, error: urllib.error.HTTPError) -> None:
        """Raise what a status means."""
        try:
            body = error.read(_MOST_ERROR_BYTES)
        except (OSError, http.client.HTTPException):
            body = b""
        code = _field(body, "error_code")
        if code == "RESOURCE_DOES_NOT_EXIST" or (code == "INVALID_PARAMETER_VALUE" and b"not found" in body):
            raise _Absent
        if error.code == 401:
            raise RegistryError(
                f"the registry {self.url} must know who asks, but it takes no or other credentials (401): "
                "give --registry-auth-file, or MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD"
            )
        if error.code == 403 and b"Invalid Host header" in body:
            host = urllib.parse.urlsplit(self.url).netloc
            raise RegistryError(
                f"the registry {self.url} must answer to this name, but it does not (403, Invalid Host header): "
                f"start it with --allowed-hosts {host}"
            )
        if error.code == 403:
            raise RegistryError(f"the registry {self.url} must let this user read the model, but it does not (403)")
        if error.code == 429 or error.code >= 500:
            raise RegistryError(f"the registry {self.url} cannot answer now (status {error.code})", away=True)
        if error.code == 404 and "get-artifact" in error.url:
            raise _Absent
        raise RegistryError(self._no_registry(f"status {error.code}"))

    def _absent(self, reference: Reference) -> str:
        """Why a reference leads nowhere, with what there is instead."""
        models = f"the registry {self.url} must have a model {reference.name}, but there is none"
        try:
            model = self._json("registered-models/get", {"name": reference.name})["registered_model"]
            if reference.alias is not None:
                aliases = [str(entry["alias"]) for entry in model.get("aliases", [])]
                missing = f"{reference.name} must have the alias {reference.alias}, but there is none"
                return missing + _choice(reference.alias, aliases, "give it one with `make promote`")
            query = {"filter": f"name = '{reference.name}'", "max_results": "100", "order_by": "version_number DESC"}
            versions = self._json("model-versions/search", query).get("model_versions", [])
            missing = f"{reference.name} must have a version {reference.version}, but there is none"
            return missing + _choice(str(reference.version), [str(v["version"]) for v in versions], "register one")
        except _Absent:
            pass
        except (KeyError, TypeError, AttributeError):
            return f"the registry {self.url} has no {reference}"
        try:
            registered = self._json("registered-models/search", {"max_results": "100"}).get("registered_models", [])
            return models + _choice(
                reference.name, [str(entry["name"]) for entry in registered], "make one with `make promote`"
            )
        except (_Absent, KeyError, TypeError, AttributeError):
            return models


def _choice(wanted: str, candidates: Iterable[str], otherwise: str) -> str:
    names = list(candidates)
    if not names:
        return f": {otherwise}"
    near = difflib.get_close_matches(wanted, names, n=1, cutoff=0.5)
    if near:
        return f", did you mean {near[0]}?"
    return f": there {'is' if len(names) == 1 else 'are'} {', '.join(names[:_MOST_NAMED])}"


def _field(body: bytes, name: str) -> str:
    try:
        return str(json.loads(body)[name])
    except (ValueError, KeyError, TypeError, RecursionError):
        return ""


def _reason(error: BaseException) -> str:
    """Why there is no connection, in words that stay the same as long as the reason does."""
    inner = error.reason if isinstance(error, urllib.error.URLError) else error
    if isinstance(inner, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({inner.verify_message}): name the authority's file in SSL_CERT_FILE"
    if isinstance(inner, OSError) and inner.strerror:
        return inner.strerror
    return str(inner) or type(inner).__name__
