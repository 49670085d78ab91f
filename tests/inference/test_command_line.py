"""The command line as a user meets it: real processes, tables, one sentence on stderr, exit codes."""

from __future__ import annotations

import importlib.metadata
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from attentionvote.inference import command_line
from attentionvote.inference.bundles.signature import make_keys
from attentionvote.inference.command_line import main

MakeBundle = Callable[..., Path]
MakeCloud = Callable[..., NDArray[np.float32]]
Said = tuple[int, str, str]
Command = Callable[..., Said]
PROGRAM = Path(sys.executable).parent / "attentionvote"


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, trusted_key: Path) -> Command:
    """Runs the command line in this process: exit code, stdout, stderr."""
    monkeypatch.setenv("ATTENTIONVOTE_KEYS", str(trusted_key.parent))
    monkeypatch.delenv("ATTENTIONVOTE_BUNDLE", raising=False)

    def run(*words: object) -> Said:
        with pytest.raises(SystemExit) as left:
            main([str(word) for word in words])
        said = capsys.readouterr()
        code = left.value.code
        assert isinstance(code, int)
        return code, said.out, said.err

    return run


@pytest.fixture
def cloud_file(tmp_path: Path, make_cloud: MakeCloud) -> Path:
    """A cloud on disk."""
    np.save(tmp_path / "cloud.npy", make_cloud())
    return tmp_path / "cloud.npy"


def one_sentence(stderr: str) -> str:
    """The only line on stderr."""
    assert stderr.startswith("attentionvote")
    assert stderr.count("\n") == 1
    assert "Traceback" not in stderr
    return stderr


def test_a_table_of_poses(command: Command, cloud_file: Path, bundle_folder: Path) -> None:
    code, out, err = command("estimate", cloud_file, "--bundle", bundle_folder)
    lines = out.splitlines()
    assert (code, err) == (0, "")
    assert lines[0] == "bracket: 2 poses in the camera frame"
    assert lines[1].split() == ["x", "mm", "y", "mm", "z", "mm", "qw", "qx", "qy", "qz", "confidence"]
    first = lines[2].split()
    assert (first[0], first[4:]) == ("1", ["0.7071", "0.0000", "0.0000", "0.7071", "0.950"])
    assert 790 < float(first[3]) < 810
    assert len({len(line) for line in lines[1:4]}) == 1
    assert lines[4].startswith("3000 of 3000 measured points, ")
    assert len(lines) == 5


def test_the_whole_answer_as_json(command: Command, cloud_file: Path, bundle_folder: Path) -> None:
    code, out, err = command("estimate", cloud_file, "--bundle", bundle_folder, "--json")
    said = json.loads(out)
    assert (code, err, out.count("\n")) == (0, "", 1)
    assert [pose["confidence"] for pose in said["poses"]] == pytest.approx([0.95, 0.7])
    assert said["units"] == "m"


def test_the_bundle_may_come_from_the_environment(
    command: Command, cloud_file: Path, bundle_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _, err = command("estimate", cloud_file)
    assert code == 2
    assert "needs a bundle, got none: give --bundle PATH or set ATTENTIONVOTE_BUNDLE" in one_sentence(err)
    monkeypatch.setenv("ATTENTIONVOTE_BUNDLE", str(bundle_folder))
    assert command("estimate", cloud_file)[0] == 0


def test_an_abstention_is_an_answer_and_not_a_failure(
    command: Command, tmp_path: Path, bundle_folder: Path, make_cloud: MakeCloud
) -> None:
    np.save(tmp_path / "few.npy", make_cloud(5))
    code, out, _ = command("estimate", tmp_path / "few.npy", "--bundle", bundle_folder)
    assert code == 0
    assert out.startswith("bracket: no pose, too_few_points: 5 points were measured, at least 30 are needed")


def test_a_deadline_in_milliseconds(command: Command, cloud_file: Path, make_bundle: MakeBundle) -> None:
    slow = make_bundle(graph={"loops": 200_000_000})
    code, out, _ = command("estimate", cloud_file, "--bundle", slow, "--deadline-ms", "200", "--json")
    assert code == 0
    assert json.loads(out)["reason"] == "deadline_exceeded"
    for wrong in ("0", "-5", "nan", "soon"):
        code, _, err = command("estimate", cloud_file, "--bundle", slow, "--deadline-ms", wrong)
        assert code == 2
        assert "--deadline-ms" in one_sentence(err)


def test_warnings_go_to_stderr(command: Command, tmp_path: Path, bundle_folder: Path, make_cloud: MakeCloud) -> None:
    np.save(tmp_path / "far.npy", make_cloud(center=(0, 0, 1.8)))
    code, out, err = command("estimate", tmp_path / "far.npy", "--bundle", bundle_folder)
    assert code == 0
    assert "warning: the scene lies farther than trained" in one_sentence(err)
    assert "warning" not in out


def test_a_cloud_in_the_cells_unit(
    command: Command, tmp_path: Path, bundle_folder: Path, make_cloud: MakeCloud
) -> None:
    np.save(tmp_path / "scan.npy", make_cloud() * np.float32(1000))
    (tmp_path / "cell.json").write_text('{"cloud": {"unit": "mm"}}')
    words = ["estimate", tmp_path / "scan.npy", "--bundle", bundle_folder, "--json"]
    code, _, err = command(*words)
    assert code == 2
    assert "were millimetres sent?" in one_sentence(err)
    code, out, _ = command(*words, "--cell", tmp_path / "cell.json")
    assert code == 0
    assert json.loads(out)["poses"]


def test_reading_has_the_command_lines_own_budget(
    command: Command, tmp_path: Path, bundle_folder: Path, make_cloud: MakeCloud, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savetxt(tmp_path / "scan.xyz", make_cloud(1000), "%.6f")
    words = ["estimate", tmp_path / "scan.xyz", "--bundle", bundle_folder, "--json"]
    code, out, _ = command(*words)
    assert (code, json.loads(out)["points_given"]) == (0, 1000)
    monkeypatch.setattr(command_line, "_MOST_READING_S", 0.0)
    code, _, err = command(*words)
    assert code == 2
    assert "must be read within 0 s of processor time" in one_sentence(err)


def test_a_depth_image_with_the_cells_camera_and_bin(command: Command, tmp_path: Path, bundle_folder: Path) -> None:
    depth = (8000 + 100 * np.random.default_rng(0).random((60, 80))).astype(np.uint16)
    depth[:, :40] = 9000  # the floor beside the bin
    Image.fromarray(depth).save(tmp_path / "depth.png")
    cell: dict[str, Any] = {"camera": {"fx": 300, "fy": 300, "cx": 40, "cy": 30, "depth_scale": 0.0001}}
    pose = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.85], [0, 0, 0, 1]]
    cell["bin"] = {"camera_from_bin": pose, "size": [0.3, 0.3, 0.1]}
    (tmp_path / "cell.json").write_text(json.dumps(cell))
    words = ["estimate", tmp_path / "depth.png", "--bundle", bundle_folder, "--json"]
    code, out, _ = command(*words, "--cell", tmp_path / "cell.json")
    assert code == 0
    assert (json.loads(out)["points_given"], json.loads(out)["points_used"]) == (4800, 2400)
    code, _, err = command(*words)
    assert code == 2
    assert "depth.png is a depth image and needs its camera: describe it in a cell file" in one_sentence(err)
    del cell["camera"]
    (tmp_path / "cell.json").write_text(json.dumps(cell))
    assert command(*words, "--cell", tmp_path / "cell.json")[0] == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["estimat"], "invalid choice: 'estimat'"),
        (["estimate"], "the following arguments are required: FILE"),
        (["estimate", "none.ply", "--bundle", "x"], "none.ply must be a file, but there is none"),
        (["estimate", "none.ply", "--bundle", "x", "--cell", "none.json"], "cell file none.json cannot be read"),
        (["estimate", "x", "--bundle", "x", "--threads", "0"], "argument --threads: must be 1 to 1024, got 0"),
        (["estimate", "x", "--bundle", "x", "--key", "k", "--no-signature"], "not allowed with argument"),
        (["verify-bundle"], "the following arguments are required: PATH"),
    ],
)
def test_wrong_words_are_one_sentence_and_code_2(command: Command, words: list[str], message: str) -> None:
    code, out, err = command(*words)
    assert (code, out) == (2, "")
    assert message in one_sentence(err)


@pytest.mark.parametrize("content", [b"junk", b"ply\n", b"", b"\x93NUMPY", b"\x89PNG\r\n\x1a\n"])
def test_a_bad_file_is_one_sentence_and_code_2(
    command: Command, tmp_path: Path, bundle_folder: Path, content: bytes
) -> None:
    (tmp_path / "file").write_bytes(content)
    code, out, err = command("estimate", tmp_path / "file", "--bundle", bundle_folder)
    assert (code, out) == (2, "")
    assert str(tmp_path / "file") in one_sentence(err)


def test_millimetres_are_one_sentence_and_code_2(
    command: Command, tmp_path: Path, bundle_folder: Path, make_cloud: MakeCloud
) -> None:
    np.save(tmp_path / "mm.npy", make_cloud() * np.float32(1000))
    code, _, err = command("estimate", tmp_path / "mm.npy", "--bundle", bundle_folder)
    assert code == 2
    assert "were millimetres sent? divide by 1000" in one_sentence(err)


def test_a_whole_bundle_is_verified(command: Command, bundle_folder: Path, trusted_key: Path) -> None:
    code, out, err = command("verify-bundle", bundle_folder)
    assert (code, err) == (0, "")
    assert "signature holds, every hash holds, golden clouds: 1" in out
    assert command("verify-bundle", bundle_folder, "--key", trusted_key)[0] == 0
    assert "signature not checked" in command("verify-bundle", bundle_folder, "--no-signature")[1]


def test_a_broken_bundle_is_one_sentence_and_code_1(
    command: Command, bundle_folder: Path, cloud_file: Path, tmp_path: Path
) -> None:
    _, other = make_keys(tmp_path / "others")
    code, out, err = command("verify-bundle", bundle_folder, "--key", other)
    assert (code, out) == (1, "")
    assert "must be signed by the trusted key" in one_sentence(err)
    content = bytearray((bundle_folder / "model.onnx").read_bytes())
    content[100] ^= 1
    (bundle_folder / "model.onnx").write_bytes(content)
    for words in (["verify-bundle", bundle_folder], ["estimate", cloud_file, "--bundle", bundle_folder]):
        code, out, err = command(*words)
        assert (code, out) == (1, "")
        assert "model.onnx must have the sha256" in one_sentence(err)
    code, _, err = command("verify-bundle", tmp_path / "none")
    assert code == 1
    assert "must be a bundle's folder" in one_sentence(err)


def test_a_bundle_with_a_bad_golden_cloud_is_not_whole(command: Command, make_bundle: MakeBundle) -> None:
    folder = make_bundle(change=lambda folder: (folder / "golden" / "cloud_0.npz").write_bytes(b"junk"))
    code, _, err = command("verify-bundle", folder)
    assert code == 1
    assert "golden/cloud_0.npz must be a golden cloud" in one_sentence(err)


def test_the_self_test_is_asked_for(command: Command, make_bundle: MakeBundle) -> None:
    code, out, err = command("verify-bundle", make_bundle(), "--self-test")
    assert (code, err) == (0, "")
    assert out.endswith("golden clouds: 1, all of them reproduced\n")

    def move(folder: Path) -> None:
        path = folder / "golden" / "cloud_0.npz"
        with np.load(path) as stored:
            arrays = dict(stored)
        arrays["camera_from_part"][:, 0, 3] += 0.002
        np.savez(path, **arrays)

    moved = make_bundle("moved", change=move)
    assert command("verify-bundle", moved)[0] == 0
    code, out, err = command("verify-bundle", moved, "--self-test")
    assert (code, out) == (1, "")
    assert "within 1 mm and 1 degree, but the nearest is off by 2.00 mm" in one_sentence(err)
    assert "(and 3 more)" in err


def test_keys_are_made_once(command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ATTENTIONVOTE_KEYS", str(tmp_path / "here"))
    code, out, err = command("keys")
    assert (code, err) == (0, "")
    assert f"{tmp_path / 'here' / 'signing.pub'}: copy it to every cell" in out
    code, _, err = command("keys")
    assert code == 1
    assert "keys are never overwritten" in one_sentence(err)
    assert command("keys", "--folder", tmp_path / "there")[0] == 0


def test_the_servers_options_are_there(command: Command) -> None:
    code, out, _ = command("serve", "--help")
    assert code == 0
    assert "--port" in out
    code, _, err = command("serve")
    assert code == 2
    assert "the following arguments are required" in one_sentence(err)


@pytest.mark.parametrize("words", [["--help"], ["estimate", "--help"], ["verify-bundle", "-h"], ["keys", "-h"]])
def test_help_is_instant(words: list[str]) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([PROGRAM, *words], capture_output=True, text=True, timeout=60, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0
    assert done.stderr == ""
    assert "usage: attentionvote" in done.stdout
    assert after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime < 1


def test_the_version_is_the_installed_one_and_instant() -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([PROGRAM, "--version"], capture_output=True, text=True, timeout=60, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    version = importlib.metadata.version("attentionvote")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"attentionvote {version}\n", "")
    assert after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime < 0.5


def test_help_loads_nothing_heavy() -> None:
    program = """
import sys
from attentionvote.inference.command_line import main
try:
    main(["--help"])
except SystemExit:
    print(sorted({"numpy", "scipy", "onnxruntime", "cryptography", "PIL", "starlette"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_ctrl_c_is_130(bundle_folder: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    words = [PROGRAM, "estimate", tmp_path / "pipe", "--bundle", bundle_folder, "--no-signature"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with (tmp_path / "pipe").open("wb"):  # waits until the program opens the other end
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert one_sentence(err) == "attentionvote: interrupted\n"


def test_a_reader_that_has_gone_is_no_traceback(bundle_folder: Path, cloud_file: Path) -> None:
    words = [PROGRAM, "estimate", cloud_file, "--bundle", bundle_folder, "--no-signature"]
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(words, stdout=writing, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    os.close(writing)
    assert done.stderr == ""


def test_an_unforeseen_failure_is_one_sentence_and_code_1(
    tmp_path: Path, bundle_folder: Path, cloud_file: Path
) -> None:
    # A package that is installed but broken, as after an interrupted update.
    (tmp_path / "onnxruntime.py").write_text("raise OSError('libonnxruntime.so: wrong ELF class')\n")
    words = [PROGRAM, "estimate", cloud_file, "--bundle", bundle_folder, "--no-signature"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False, env=environment)
    assert done.returncode == 1
    assert "OSError: libonnxruntime.so: wrong ELF class (ATTENTIONVOTE_TRACEBACK=1 shows" in one_sentence(done.stderr)
    environment["ATTENTIONVOTE_TRACEBACK"] = "1"
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False, env=environment)
    assert "Traceback" in done.stderr
