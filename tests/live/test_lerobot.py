"""The step for LeRobot's policies: what comes out is a motion that the load survives. Runs where that is installed."""

import json

import numpy as np
import pytest

pytest.importorskip("lerobot.processor", reason="LeRobot is not installed; pip install 'salver[lerobot]'")

import torch
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.processor import PolicyProcessorPipeline, UnnormalizerProcessorStep
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from scipy.interpolate import CubicSpline

import salver as sv
from live_runs import Loop, executed, rows_of
from salver.errors import ScenarioError
from salver.live.lerobot import KeepLoad
from salver.trajectory import JointMotion

pytestmark = pytest.mark.slow

FPS = 30.0


def recorded(step):
    """The loop that notes what a step commands from now on."""
    loop = Loop(step.live)
    step.live.command = loop.command
    return loop


def outcome(motion, step):
    """What becomes of the load when the tray does a joint motion."""
    columns = {"t": motion.t, **dict(zip(step.live.problem.arm.joint_names, motion.q.T, strict=True))}
    return sv.simulate(columns, step.scenario).summary["outcome"]


def swing(step, count, amplitude, frequency):
    """(count, n) rad: the first joint to and fro, beginning at rest."""
    t = np.arange(1, count + 1) / FPS
    turn = amplitude * 0.5 * (1 - np.cos(2 * np.pi * frequency * t))
    return step.live.problem.start.q + turn[:, None] * np.eye(step.live.problem.n)[0]


def test_a_gentle_chunk_passes_as_it_is():
    step = KeepLoad("panda-cube", fps=FPS)
    wanted = swing(step, 30, 0.1, 0.5)
    out = step.action(torch.tensor(wanted[None]))
    assert out.shape == (1, 30, 7)
    assert out.dtype == torch.float64
    assert np.abs(out.numpy()[0] - wanted).max() < 2e-3


def test_actions_one_by_one_lag_by_less_than_two_of_them():
    step = KeepLoad("panda-cube", fps=FPS)
    wanted = swing(step, 30, 0.1, 0.5)
    out = np.array([step.action(torch.tensor(row, dtype=torch.float32)).numpy() for row in wanted])
    fastest = 0.1 * np.pi * 0.5  # rad/s
    assert np.abs(out - wanted).max() < 2 * fastest / FPS


def test_what_would_lose_the_cube_is_bent_until_it_does_not():
    """0.4 rad to and fro three times in two seconds takes 17 rad/s^2, half a metre from the axis; friction gives 4.9
    m/s^2. The policy's motion loses the cube in the engine, what comes out keeps it and breaks no row."""
    step = KeepLoad("panda-cube", fps=FPS)
    loop = recorded(step)
    wild = swing(step, 60, 0.4, 1.5)
    out = step.action(torch.tensor(wild)).numpy()
    assert np.ptp(out[:, 0]) > 0.1
    step.action(torch.tensor(np.repeat(wild[-1:], 40, axis=0)))  # the same on and on: it comes to rest there
    motion = executed(loop.told)
    assert max(rows_of(step.live.problem, loop.told).values()) <= 0.0
    assert outcome(motion, step) == "holds"
    asked = CubicSpline(np.arange(61) / FPS, np.vstack([step.live.problem.start.q, wild]), bc_type="clamped")
    t = np.linspace(0, 2.0, 2001)
    assert outcome(JointMotion(t, asked(t), asked(t, 1), asked(t, 2)), step) != "holds"


def test_in_a_pipeline_after_the_unnormaliser_written_and_read_again(tmp_path):
    """Actions of a policy are normalised, in degrees, with a gripper behind; the step is built again from its file."""
    step = KeepLoad("panda-cube", fps=FPS, degrees=True, execute=5)
    start = np.rad2deg(step.live.problem.start.q)
    mean = torch.tensor([*start, 0.5])
    features = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(8,))}
    scale = UnnormalizerProcessorStep(
        features=features,
        norm_map={FeatureType.ACTION: NormalizationMode.MEAN_STD},
        stats={"action": {"mean": mean, "std": torch.full((8,), 10.0)}},
    )
    both = {"to_transition": policy_action_to_transition, "to_output": transition_to_policy_action}
    pipeline = PolicyProcessorPipeline(steps=[scale, step], name="post", **both)
    normal = torch.zeros((1, 10, 8))
    normal[..., 7] = 0.05  # the gripper
    normal[0, :, 0] = torch.linspace(0, 0.01, 10)
    out = pipeline(normal)
    assert out.shape == (1, 5, 8)
    assert np.allclose(out[0, :, :7], start + 10.0 * normal[0, :5, :7].numpy(), atol=0.2)
    assert np.allclose(out[0, :, 7], 1.0)
    pipeline.save_pretrained(tmp_path)
    again = PolicyProcessorPipeline.from_pretrained(tmp_path, config_filename="post.json", **both)
    assert again.steps[1].get_config() == step.get_config()
    assert json.loads((tmp_path / "post.json").read_text())["steps"][1]["registry_name"] == "salver_keep_load"
    assert torch.equal(again(normal), out)
    pipeline.reset()
    assert torch.equal(pipeline(normal), out)


def test_a_policy_that_was_never_trained_keeps_the_cube():
    """ACT with random weights says anything at all within 0.3 rad; each of five chunks is carried out by half."""
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    torch.manual_seed(0)
    step = KeepLoad("panda-cube", fps=FPS, execute=10)
    loop = recorded(step)
    vector = {"observation.state": FeatureType.STATE, "observation.environment_state": FeatureType.ENV}
    policy = ACTPolicy(ACTConfig(
        chunk_size=20, n_action_steps=10, dim_model=64, n_heads=2, dim_feedforward=64, use_vae=False, device="cpu",
        input_features={name: PolicyFeature(type=kind, shape=(7,)) for name, kind in vector.items()},
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(7,))},
    ))  # fmt: skip
    start = torch.tensor(step.live.problem.start.q, dtype=torch.float32)
    for _ in range(5):
        seen = {name: torch.randn(1, 7) for name in vector}
        chunk = start + 0.3 * torch.tanh(10 * policy.predict_action_chunk(seen))
        assert step.action(chunk).shape == (1, 10, 7)
    motion = executed(loop.told)
    assert np.abs(motion.q - motion.q[0]).max() > 0.02
    step.execute = None
    step.action(chunk[:, -1].repeat(40, 1))
    motion = executed(loop.told)
    assert max(rows_of(step.live.problem, loop.told).values()) <= 0.0
    assert outcome(motion, step) == "holds"


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.zeros(6), r"has shape \(6,\); it must be \(7,\), \(T, 7\) or \(1, T, 7\)"),
        (torch.zeros((2, 4, 7)), r"has shape \(2, 4, 7\)"),
        (torch.tensor(0.0), r"has shape \(\)"),
        (torch.full((3, 7), float("nan")), "not finite"),
    ],
)
def test_what_is_no_action_is_refused_in_a_sentence(action, message):
    with pytest.raises(ValueError, match=message):
        KeepLoad("panda-cube").action(action)


@pytest.mark.parametrize("wrong", [{"fps": 0.0}, {"every": -1.0}, {"execute": 0}, {"scenario": "panda-cup"}])
def test_a_step_that_cannot_be_is_refused(wrong):
    with pytest.raises(ScenarioError):
        KeepLoad(**{"scenario": "panda-cube", **wrong})


def test_beyond_a_joint_limit_counts_as_at_it():
    step = KeepLoad("panda-cube", fps=FPS)
    out = step.action(torch.full((5, 7), 1e6)).numpy()
    limits = step.live.problem.limits
    assert np.all((out >= limits.q_min) & (out <= limits.q_max))
