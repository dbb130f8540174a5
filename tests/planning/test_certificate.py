"""A plan's files belong together: whatever is edited, mixed or taken away afterwards is refused, by its name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rewritten_runs import rewrite
from salver import scenario
from salver.errors import FileFormatError
from salver.export.motion import read_motion
from salver.files import load_npz, read_json
from salver.planning.make import make_plan
from salver.planning.plan import load_plan
from salver.reports.run import read_run
from salver.run_directory import CERTIFICATE

CASE = scenario.load("panda-cube").with_changes(motion__duration=1.6, motion__nodes=21)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certified")
    make_plan(CASE).save(folder)
    make_plan(CASE, "baseline").save(folder, "baseline")
    return folder


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def _other(value: np.ndarray) -> np.ndarray:
    """The same array, the last bit of its last number (or a letter of a word) changed."""
    value = value.copy()
    value.flat[-1] = np.nextafter(value.flat[-1], np.inf) if value.dtype.kind == "f" else "x"
    return value


@pytest.mark.slow
def test_a_plan_that_nobody_touched_is_read(run: Path) -> None:
    assert load_plan(run).ok
    assert load_plan(run, "baseline").method == "baseline"
    assert read_run(run).plan.arrays.keys() == load_npz(run / "plan.npz").keys()


@pytest.mark.slow
def test_the_last_bit_of_any_array_is_seen_and_the_array_named(run: Path) -> None:
    names = list(load_npz(run / "plan.npz"))
    assert {"joint_t", "joint_q", "joint_dq", "joint_ddq", "position_coefficients"} <= set(names)
    kept = (run / "plan.npz").read_bytes()
    for name in names:
        rewrite(run, arrays=lambda held, name=name: held.update({name: _other(held[name])}), certified=False)  # type: ignore[misc]
        with pytest.raises(FileFormatError, match=rf"plan\.npz was edited since .* array {name} is not what was"):
            load_plan(run)
        (run / "plan.npz").write_bytes(kept)
    load_plan(run)


@pytest.mark.slow
def test_any_field_of_the_record_is_seen_and_named(run: Path) -> None:
    record = read_json(run / "plan.json")
    for key in [key for key in record if key != CERTIFICATE]:
        (run / "plan.json").write_text(json.dumps({**record, key: "edited"}))
        with pytest.raises(FileFormatError, match=rf"plan\.json was edited since .* key {key} "):
            load_plan(run)
    record["arm"]["ok"] = not record["arm"]["ok"]
    (run / "plan.json").write_text(json.dumps(record))
    with pytest.raises(FileFormatError, match=r"key arm "):
        load_plan(run)


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (lambda held: held.update(q_extra=np.zeros(3)), "q_extra"),
        (lambda held: held.pop("joint_ddq"), "joint_ddq"),
        (lambda held: held.update(joint_q=held["joint_q"].astype(np.float32)), "joint_q"),
        (lambda held: held.update(joint_q=held["joint_q"].reshape(-1)), "joint_q"),
        (lambda held: held.update(angular_velocity_coefficients=np.zeros((3, 3))), "angular_velocity_coefficients"),
    ],
)
def test_arrays_that_come_or_go_or_change_their_kind(run: Path, edit: Callable[[Any], Any], named: str) -> None:
    rewrite(run, arrays=edit, certified=False)
    with pytest.raises(FileFormatError, match=f"array {named} "):
        load_plan(run)


def test_arrays_that_are_thought_of_later_are_covered(run: Path) -> None:
    rewrite(run, arrays=lambda held: held.update(stop_q=np.ones((4, 7))))
    load_plan(run)
    rewrite(run, arrays=lambda held: held.update(stop_q=2 * np.ones((4, 7))), certified=False)
    with pytest.raises(FileFormatError, match="array stop_q "):
        load_plan(run)


def test_files_of_another_plan_do_not_fit(run: Path) -> None:
    for ending in ("npz", "json"):
        kept = (run / f"plan.{ending}").read_bytes()
        shutil.copy(run / f"baseline.{ending}", run / f"plan.{ending}")
        with pytest.raises(FileFormatError, match="was edited since"):
            load_plan(run)
        (run / f"plan.{ending}").write_bytes(kept)
    text = (run / "scenario.toml").read_text()
    (run / "scenario.toml").write_text(text.replace("friction = 0.5", "friction = 0.6"))
    with pytest.raises(FileFormatError, match=r"scenario\.toml was edited since .* key objects "):
        load_plan(run)
    (run / "scenario.toml").write_text("# a remark changes nothing\n" + text)
    load_plan(run)


def test_a_plan_without_a_certificate_says_what_it_is_and_how_to_plan_again(run: Path) -> None:
    rewrite(run, record=lambda record: record.pop(CERTIFICATE), certified=False)
    again = rf"plan again with `salver plan {run}/scenario\.toml -o ANOTHER_DIRECTORY`"
    with pytest.raises(FileFormatError, match=rf"plan\.json has no certificate: .*; {again}\."):
        load_plan(run)


@pytest.mark.parametrize("reader", [load_plan, read_run, read_motion])
def test_everything_that_reads_a_plan_refuses(run: Path, reader: Callable[[Path], Any]) -> None:
    rewrite(run, arrays=lambda held: held["joint_q"].__setitem__((3, 2), 0.1), certified=False)
    with pytest.raises(FileFormatError, match="array joint_q "):
        reader(run)


def test_a_mesh_that_was_edited_is_named(tmp_path: Path) -> None:
    import trimesh

    mesh = tmp_path / "cube.obj"
    trimesh.creation.box((0.04, 0.04, 0.04)).export(mesh)
    shape = {"type": "mesh", "file": str(mesh)}
    make_plan(CASE.with_changes(arm=None, objects__0__shape=shape)).save(tmp_path / "run")
    load_plan(tmp_path / "run")
    mesh.write_bytes(mesh.read_bytes() + b"\n# a remark\n")
    with pytest.raises(FileFormatError, match=rf"file {mesh} is not what was judged"):
        load_plan(tmp_path / "run")


def test_a_certificate_that_fits_nonsense_still_gets_a_sentence(run: Path) -> None:
    rewrite(run, record=lambda record: record.update(status="fine"))
    with pytest.raises(FileFormatError, match="are not those of a plan"):
        load_plan(run)
