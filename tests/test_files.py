"""Files: whole or not at all, the same bytes for the same content, a sentence for what cannot be read."""

import json
import os

import numpy as np
import pytest

from salver import files
from salver.errors import FileFormatError, SalverError
from salver.scenario import load


def _saved(path, **arrays):
    return files.write_atomic(path, files.npz_bytes(arrays))


def test_arrays_come_back_identical(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "t": rng.normal(size=7),
        "state_sensitivity": rng.normal(size=(7, 12, 2)),
        "parameter_names": np.array(["mass", "com_x"]),
        "count": np.array(3),
        "nothing": np.zeros((0, 3)),
        "not_a_number": np.array([np.nan, -np.inf]),
    }
    back = files.load_npz(_saved(tmp_path / "plan.npz", **arrays))
    assert list(back) == list(arrays)
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)


def test_same_arrays_same_bytes(tmp_path):
    a = _saved(tmp_path / "a.npz", x=np.arange(5.0)).read_bytes()
    b = _saved(tmp_path / "b.npz", x=np.arange(5.0)).read_bytes()
    assert a == b


def test_every_truncation_of_an_array_file_is_noticed(tmp_path):
    whole = _saved(tmp_path / "plan.npz", x=np.arange(40.0), y=np.ones((3, 3))).read_bytes()
    short = tmp_path / "short.npz"
    for length in [*range(0, len(whole), 23), len(whole) - 1]:
        short.write_bytes(whole[:length])
        with pytest.raises(FileFormatError, match=r"short\.npz is truncated or is not a file of arrays"):
            files.load_npz(short)


def test_a_flipped_bit_in_the_data_is_noticed(tmp_path):
    path = _saved(tmp_path / "plan.npz", x=np.arange(100.0))
    content = bytearray(path.read_bytes())
    content[content.find(np.arange(100.0).tobytes()[80:160])] ^= 1
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="truncated or is not"):
        files.load_npz(path)


class _Booby:
    """Unpickling this creates a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (os.mkdir, (str(self.path),))


def test_loading_never_unpickles(tmp_path):
    trap = tmp_path / "executed"
    np.savez(tmp_path / "evil.npz", x=np.array([_Booby(trap)], dtype=object))
    with pytest.raises(FileFormatError, match=r"evil\.npz"):
        files.load_npz(tmp_path / "evil.npz")
    assert not trap.exists()
    with pytest.raises(TypeError, match="array x holds Python objects"):
        _saved(tmp_path / "mine.npz", x=np.array([_Booby(trap)], dtype=object))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda p: None, "cannot be read: no such file or directory"),
        (lambda p: p.mkdir(), "cannot be read: is a directory"),
        (lambda p: p.write_text("t,x\n0,1\n"), "truncated or is not a file of arrays"),
        (lambda p: p.with_suffix(".npy").write_bytes(b"") or _save_npy(p), "truncated or is not a file of arrays"),
        (lambda p: _saved(p, x=np.zeros(2)), "has no array t; it holds x"),
    ],
    ids=["missing", "directory", "text", "single-array", "lacks-array"],
)
def test_foreign_array_files(tmp_path, make, sentence):
    path = tmp_path / "plan.npz"
    make(path)
    with pytest.raises(FileFormatError) as error:
        files.load_npz(path, required=("t",))
    assert sentence in str(error.value)
    assert "plan.npz" in str(error.value)
    assert str(error.value).endswith(".")


def _save_npy(path):
    with open(path, "wb") as file:
        np.save(file, np.zeros(3))


def test_json_of_numpy_values(tmp_path):
    path = files.write_json(
        tmp_path / "plan.json",
        {
            "float": np.float64(0.1),
            "integer": np.int32(4),
            "flag": np.bool_(True),
            "array": np.arange(6).reshape(2, 3),
            "nan": float("nan"),
            "list": [np.inf, (1, 2)],
            "path": tmp_path / "x",
            "word": "±10 %",
        },
    )
    assert files.read_json(path) == {
        "float": 0.1,
        "integer": 4,
        "flag": True,
        "array": [[0, 1, 2], [3, 4, 5]],
        "nan": None,
        "list": [None, [1, 2]],
        "path": str(tmp_path / "x"),
        "word": "±10 %",
    }


def test_json_floats_round_trip_exactly(tmp_path):
    values = np.random.default_rng(1).normal(size=200) * 10.0 ** np.arange(-100, 100)
    back = files.read_json(files.write_json(tmp_path / "x.json", values))
    np.testing.assert_array_equal(np.array(back), values)


def test_json_refuses_what_it_cannot_hold(tmp_path):
    with pytest.raises(TypeError, match="a object cannot be written as JSON"):
        files.write_json(tmp_path / "x.json", {"a": object()})
    with pytest.raises(TypeError, match="string keys"):
        files.write_json(tmp_path / "x.json", {1: "a"})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b'{"status": "opt', "truncated or is not JSON"),
        (b"", "truncated or is not JSON"),
        (b"\xff\xfe\x00", "not a text file in UTF-8"),
    ],
)
def test_foreign_json(tmp_path, content, sentence):
    (tmp_path / "plan.json").write_bytes(content)
    with pytest.raises(FileFormatError, match=sentence):
        files.read_json(tmp_path / "plan.json")


def test_an_interrupted_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = files.write_atomic(tmp_path / "plan.json", "old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SalverError, match=r"plan\.json cannot be written: no space left on device"):
        files.write_atomic(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["plan.json"]


def test_who_reads_a_file_while_it_is_written_sees_all_of_the_old_one(tmp_path):
    path = files.write_atomic(tmp_path / "plan.json", "old " * 3)
    with open(path, "rb", buffering=0) as reader:
        assert reader.read(4) == b"old "
        files.write_atomic(path, "new")
        assert reader.read() == b"old old "
    assert path.read_text() == "new"


def test_a_place_that_cannot_be_written_to(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SalverError, match="cannot be written: "):
        files.write_atomic(tmp_path / "file" / "plan.json", "x")


def test_a_device_or_a_pipe_is_not_replaced_by_a_file(tmp_path):
    """As root a file takes the place of /dev/null; a pipe may be any user's."""
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    with pytest.raises(SalverError, match=r"pipe\.csv is a device or a pipe; name a file\."):
        files.write_atomic(pipe, "x")
    assert pipe.is_fifo()
    assert [p.name for p in tmp_path.iterdir()] == ["pipe.csv"]


def test_provenance_follows_the_scenario():
    scenario = load("panda-cube")
    record = files.provenance(scenario)
    assert record == files.provenance(load("panda-cube"))
    assert record["scenario_digest"] == scenario.digest
    assert record["versions"]["numpy"] == np.__version__
    json.dumps(record)
    longer = scenario.with_changes(motion__duration=2.6)
    assert files.provenance(longer)["scenario_digest"] != record["scenario_digest"]
