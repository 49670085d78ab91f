"""``attentionvote`` on a cell's command line: estimate a file, verify, fetch or serve a bundle, make keys, read on.

Results go to stdout, everything else to stderr as one sentence. Exit codes: 0 done, 1 the bundle or the machine is at
fault, 2 the input or the command is, 130 interrupted. Heavy imports stand where they are used: ``--help`` is instant.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from attentionvote.inference.errors import BundleError, InputError

if TYPE_CHECKING:
    from attentionvote.inference.answer import Abstention, Estimate
    from attentionvote.inference.bundles.bundle import Trusted

OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
BUNDLE_VARIABLE = "ATTENTIONVOTE_BUNDLE"
# Verbs that lie in a module of their own, which is loaded only for them: name, module, help and description.
_ELSEWHERE = (
    ("serve", "server.serve", "the cell's HTTP server", "Serve a bundle over HTTP."),
    ("health", "server.health", "is a server ready? exit code 0 or 1", "Ask a server."),
    ("fetch", "fetching.command", "fetch a bundle from a registry", "Fetch a bundle, verify it."),
    ("docs", "documentation", "the operator's pages", "List the pages, or print one."),
)
# For one file: whoever types a command waits for it, and nobody else does.
_MOST_READING_S = 60.0


class _Parser(argparse.ArgumentParser):
    """A parser whose refusal is one sentence on stderr."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message}: see {self.prog} --help\n")


class _Version(argparse.Action):
    """Prints the installed version; looked up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        import importlib.metadata

        print(f"{parser.prog} {importlib.metadata.version('attentionvote')}")
        parser.exit(OK)


def main(words: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and leave the process."""
    words = list(sys.argv[1:] if words is None else words)
    code = FAILED
    try:
        options = _parser(words).parse_args(words)
        code = options.run(options)
        sys.stdout.flush()
    except InputError as error:
        code = BAD_INPUT
        _say(error)
    except BundleError as error:
        _say(error)
    except KeyboardInterrupt:
        code = INTERRUPTED
        _say("interrupted")
    except BrokenPipeError:
        # Whoever read the result has gone; what Python flushes at its end must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        if os.environ.get("ATTENTIONVOTE_TRACEBACK"):
            raise
        first = (str(error).splitlines() or [""])[0]
        _say(f"{type(error).__name__}: {first} (ATTENTIONVOTE_TRACEBACK=1 shows where)")
    sys.exit(code)


def _say(message: object) -> None:
    """One line on stderr, whatever the message holds."""
    print("attentionvote:", " ".join(str(message).split()), file=sys.stderr)


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """The parser; the options of verbs that lie elsewhere are looked up only where they are asked for."""
    parser = _Parser(prog="attentionvote", description="6D poses of parts in a bin, from a signed model bundle.")
    parser.add_argument("--version", action=_Version, nargs=0, help="say the version and end")
    verbs = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=_Parser)

    verb = verbs.add_parser("estimate", help="poses in one cloud or depth image", description=_estimate.__doc__)
    verb.add_argument(
        "file", metavar="FILE", help="PLY, PCD, NPY or NPZ in metres; with a camera in --cell also a depth PNG"
    )
    _add_bundle_options(verb)
    verb.add_argument("--cell", metavar="FILE", help="JSON with the cell's camera and bin")
    verb.add_argument("--deadline-ms", type=_milliseconds, metavar="N", help="stop and abstain after this time")
    verb.add_argument("--threads", type=_threads, default=1, metavar="N", help="of the graph (default: 1)")
    verb.add_argument("--json", action="store_true", help="the whole answer as one JSON object")
    verb.set_defaults(run=_estimate)

    verb = verbs.add_parser("verify-bundle", help="is a bundle whole and signed?", description=_verify_bundle.__doc__)
    verb.add_argument("path", metavar="PATH", help="the bundle's folder")
    _add_key_options(verb)
    verb.add_argument("--self-test", action="store_true", help="also estimate its golden clouds, as a cell does")
    verb.set_defaults(run=_verify_bundle)

    for name, module, text, description in _ELSEWHERE:
        verb = verbs.add_parser(name, help=text, description=description)
        if words[:1] == [name]:
            verb_module = import_module(f"attentionvote.inference.{module}")
            verb_module.add_arguments(verb)
            verb.set_defaults(run=verb_module.run)

    verb = verbs.add_parser("keys", help="make the key pair that signs bundles", description=_keys.__doc__)
    verb.add_argument("--folder", metavar="PATH", help="default: $ATTENTIONVOTE_KEYS or ~/.config/attentionvote")
    verb.set_defaults(run=_keys)
    return parser


def _add_bundle_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--bundle",
        metavar="PATH",
        default=os.environ.get(BUNDLE_VARIABLE),
        help=f"its folder; default: ${BUNDLE_VARIABLE}",
    )
    _add_key_options(parser)


def _add_key_options(parser: argparse.ArgumentParser) -> None:
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--key", metavar="FILE", help="public key that must have signed it; default: signing.pub")
    which.add_argument("--no-signature", action="store_true", help="check the hashes only")


def _milliseconds(word: str) -> float:
    value = float(word)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"must be positive milliseconds, got {word}")
    return value


def _threads(word: str) -> int:
    value = int(word)
    if not 1 <= value <= 1024:
        raise argparse.ArgumentTypeError(f"must be 1 to 1024, got {word}")
    return value


def _trusted(options: argparse.Namespace) -> Trusted:
    """Whose signature the options demand."""
    from attentionvote.inference.bundles.signature import PUBLIC_NAME, keys_folder

    if options.no_signature:
        return None
    return Path(options.key) if options.key else keys_folder() / PUBLIC_NAME


def _estimate(options: argparse.Namespace) -> int:
    """Estimate the poses in one cloud or depth image and print them as a table, or as JSON."""
    from attentionvote.inference.cell import Cell, read_cell
    from attentionvote.inference.estimator import PoseEstimator
    from attentionvote.inference.scans.cloud_files import read_cloud
    from attentionvote.inference.scans.depth_files import PNG_MAGIC, read_depth
    from attentionvote.inference.scans.file_bytes import file_bytes
    from attentionvote.inference.scans.limits import Budget

    if not options.bundle:
        raise InputError(f"estimate needs a bundle, got none: give --bundle PATH or set {BUNDLE_VARIABLE}")
    cell = read_cell(options.cell) if options.cell else Cell()
    content, name = file_bytes(options.file)
    deadline_s = options.deadline_ms / 1000 if options.deadline_ms else None
    # A file that cannot be read is refused before the bundle is loaded.
    if content.startswith(PNG_MAGIC):
        if cell.camera is None:
            raise InputError(f"{name} is a depth image and needs its camera: describe it in a cell file, --cell FILE")
        scan: dict[str, Any] = {"depth": read_depth(content, name), "camera": cell.camera}
    else:
        scan = {"points": cell.cloud.metres(read_cloud(content, name, budget=Budget(most_seconds=_MOST_READING_S)))}
    with PoseEstimator(
        options.bundle, threads=options.threads, crop=cell.crop, camera=cell.camera, trusted=_trusted(options)
    ) as estimator:
        answer = estimator.estimate(**scan, deadline_s=deadline_s)
    if options.json:
        print(json.dumps(answer.to_dict(), allow_nan=False))
    else:
        print(table(answer))
        for warning in answer.warnings:
            _say(f"warning: {warning}")
    return OK


def table(answer: Estimate | Abstention) -> str:
    """An answer for a terminal: one line a pose, positions in millimetres, quaternions (w, x, y, z)."""
    from attentionvote.geometry.pose import quaternion_from_matrix
    from attentionvote.inference.answer import Abstention

    total = answer.seconds.get("total", math.nan)
    facts = (
        f"{answer.points_used} of {answer.points_measured} measured points, {1000 * total:.0f} ms, model {answer.model}"
    )
    if isinstance(answer, Abstention):
        return f"{answer.part}: no pose, {answer.reason}: {answer.message}\n{facts}"
    rows = [["", "x mm", "y mm", "z mm", "qw", "qx", "qy", "qz", "confidence"]]
    for number, detection in enumerate(answer.detections, 1):
        position = [f"{1000 * value:.1f}" for value in detection.camera_from_part[:3, 3]]
        turn = [f"{value:.4f}" for value in quaternion_from_matrix(detection.camera_from_part[:3, :3])]
        rows.append([str(number), *position, *turn, f"{detection.confidence:.3f}"])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    count = len(answer.detections)
    summary = f"{answer.part}: {count} pose{'s' * (count > 1)} in the camera frame"
    return "\n".join([summary, *lines, facts])


def _verify_bundle(options: argparse.Namespace) -> int:
    """Check a bundle's signature, the hash of every file, and that model and card belong together."""
    from attentionvote.inference.bundles.bundle import load_bundle

    trusted = _trusted(options)
    bundle = load_bundle(options.path, trusted)
    clouds = len(bundle.golden())
    report = "signature not checked" if trusted is None else "signature holds"
    report += f", every hash holds, golden clouds: {clouds}"
    if options.self_test:
        from attentionvote.inference.estimator import PoseEstimator
        from attentionvote.inference.golden import self_test

        with PoseEstimator(bundle) as estimator:
            if problems := self_test(estimator, bundle):
                more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
                raise BundleError(f"{options.path}: {problems[0]}{more}")
        report += ", all of them reproduced"
    print(f"{options.path}: {bundle.card.part.name}, bundle {bundle.digest[:12]}: {report}")
    return OK


def _keys(options: argparse.Namespace) -> int:
    """Make the key pair that signs bundles; never overwrites one."""
    from attentionvote.inference.bundles.signature import fingerprint, keys_folder, load_public_key, make_keys

    private, public = make_keys(Path(options.folder) if options.folder else keys_folder())
    print(f"key {fingerprint(load_public_key(public))}")
    print(f"{private}: keep it where bundles are exported, never give it away")
    print(f"{public}: copy it to every cell")
    return OK


if __name__ == "__main__":
    main()
