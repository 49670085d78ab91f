"""What every verb has in common: help, configuration, errors, exit codes, the line on stdout.

A verb is a script ``pipelines/<verb>.py`` with a function ``run(settings) -> dict``::

    if __name__ == "__main__":
        command(TrainSettings, run)

The dictionary is printed as the only line on stdout, one JSON object; everything else that is
printed while the verb runs, by anybody, goes to stderr. Exit codes: 0 success, 2 impossible
configuration (before any work), 130 and 143 interrupted (Ctrl-C, SIGTERM), 1 anything else
(``Refused`` prints its line too).
With ``-m`` the words are a grid of jobs (``grid.py``). Heavy imports belong inside ``run``, so that
``--help`` and a misspelt word are answered at once.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from attentionvote.command.command_line import command_line
from attentionvote.command.conf_folder import CONF, add_folder, folders, primary_file, see_modules
from attentionvote.command.configuration import Settings, compose
from attentionvote.command.errors import ConfigurationError, Refused, sentence
from attentionvote.command.grid import run_grid
from attentionvote.command.help import help_text
from attentionvote.command.interruption import catch_sigterm, ignore_sigterm, interruption
from attentionvote.execution.job_process import join_starter, report_failure
from attentionvote.files import FolderUnavailable

Run = Callable[[Settings], dict[str, Any] | None]
Defaults = Callable[[list[str]], list[str]]
Check = Callable[[Settings], object]
LOGS = Path("outputs/logs")
# Threads that wait for work sleep: spinning ones make a shared machine several times slower (torch reads this once).
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def command(
    settings: type[Settings],
    run: Run[Settings],
    *,
    defaults: Defaults | None = None,
    check: Check[Settings] | None = None,
    conf: Path = CONF,
) -> NoReturn:
    """Run a verb with the words of the command line and leave the process.

    Args:
        settings: of the verb; ``verb`` is the stem of the script and of its configuration file.
        run: does the work; its dictionary becomes the JSON line (None: another process of the same work prints it).
        defaults: given the user's words, further overrides that stand for the machine's default
            (they come first, so the user's words win).
        check: raises when a configuration cannot work, before the first job of a grid starts; ``run`` checks its own.
        conf: folder of the configuration files.
    """
    verb = settings.verb
    join_starter()
    catch_sigterm()
    _log_to_stderr()
    with _reporting_errors(verb):
        line = command_line(sys.argv[1:])
        if line.config_dir is not None:
            add_folder(line.config_dir, conf)
        elif user := folders(conf)[1:]:
            add_folder(user[0], conf)
        see_modules()
        words, name = line.overrides, line.config_name
        if line.help:
            print(help_text(settings, conf, name))
            sys.exit(0)
        machine = defaults(words) if defaults is not None and name is None else []  # a named one says everything
        if line.shows:
            _show(line.shows, [*machine, *words], name or verb, conf)
        elif line.multirun:
            same = [] if name is None else [f"--config-name={name}"]
            run_grid(verb, words, machine, same, lambda job: compose(settings, job, conf, name), _configuring(check))
        else:
            _print_result(run, compose(settings, [*machine, *words], conf, name))
    sys.exit(0)


@contextmanager
def configuring(what: str = "") -> Iterator[None]:
    """Around code that only builds things from the configuration: its expected errors are configuration errors.

    Args:
        what: put in front of the sentence, e.g. ``object gear``.

    Raises:
        ConfigurationError: instead of ValueError, TypeError and OSError (a missing mesh, say).
    """
    try:
        yield
    except (ConfigurationError, FolderUnavailable):
        raise
    except (ValueError, TypeError, OSError) as error:
        raise ConfigurationError(_prefixed(what, error)) from error


def _prefixed(what: str, error: BaseException) -> str:
    return f"{what}: {sentence(error)}" if what else sentence(error)


def _print_result(run: Run[Settings], settings: Settings) -> None:
    """Run with file descriptor 1 pointing at stderr, so that the result is the only line on stdout."""
    sys.stdout.flush()
    stdout = os.dup(1)
    os.dup2(2, 1)
    refusal, result = None, None
    try:
        try:
            result = run(settings)
        except Refused as error:
            refusal, result = error, error.result
        sys.stdout.flush()
    finally:
        os.dup2(stdout, 1)
        os.close(stdout)
    if result is not None:
        print(json.dumps(result, default=_jsonable), flush=True)
    if refusal is not None:
        raise refusal


def _jsonable(value: Any) -> Any:
    if hasattr(value, "tolist"):  # numpy and torch scalars and arrays
        return value.tolist()
    return str(value)


def _configuring(check: Check[Settings] | None) -> Check[Settings] | None:
    """The check with its expected errors made configuration errors."""
    if check is None:
        return None

    def checked(settings: Settings) -> None:
        with configuring(f"object {settings.composed['object']['name']}"):
            check(settings)

    return checked


def _show(flags: Sequence[str], words: Sequence[str], name: str, conf: Path) -> None:
    """What Hydra shows of itself and of a configuration (``--cfg job``, ``--info`` ...); nothing is run."""
    import hydra

    primary = primary_file(name, conf)
    beside = [f"--config-dir={folder}" for folder in folders(conf) if folder != primary.parent]
    sys.argv = [sys.argv[0], *flags, *beside, *words]
    hydra.main(config_path=str(primary.parent), config_name=name, version_base="1.3")(_nothing)()


def _nothing(_: object) -> None:
    """The task of a flag that only shows."""


@contextmanager
def _reporting_errors(verb: str) -> Iterator[None]:
    """Every exception becomes one sentence on stderr and an exit code."""
    try:
        yield
    except BaseException as error:
        ignore_sigterm()
        if isinstance(error, (ConfigurationError, FolderUnavailable)):
            _leave(f"{verb}: {sentence(error)}", 2)
        if isinstance(error, Refused):
            _leave(f"{verb}: {sentence(error)}", 1)
        code = interruption(error)
        if code is not None:
            _leave(f"{verb}: interrupted; run the same command to resume", code)
        if isinstance(error, SystemExit):
            raise
        expected = isinstance(error, (ValueError, OSError))
        kind = "" if expected else f"{type(error).__name__}: "
        _leave(f"{verb}: {kind}{sentence(error)}{_details(verb)}", 1)


def _leave(message: str, code: int) -> NoReturn:
    sys.stdout.flush()
    print(message, file=sys.stderr, flush=True)
    report_failure(message.partition(": ")[2])
    raise SystemExit(code) from None


def _details(verb: str) -> str:
    """Where the traceback is, for the end of a sentence; nothing when it cannot be written (a full disk, say)."""
    path = LOGS / f"{verb}-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.log"
    try:
        LOGS.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{' '.join(sys.argv)}\n\n{traceback.format_exc()}", encoding="utf-8")
    except OSError:
        return ""
    return f" (details in {path})"


class _Plain(logging.Formatter):
    """Information as it is, anything graver with its level in front."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno <= logging.INFO else f"{record.levelname.lower()}: {text}"


def _log_to_stderr() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Plain("%(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    for name in ("attentionvote", "__main__"):
        logging.getLogger(name).setLevel(logging.INFO)
    logging.captureWarnings(True)
