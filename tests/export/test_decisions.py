"""Exported decisions: the policies' own in every format, the contract that lies beside them, and what is refused."""

import dataclasses
import hashlib
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest
from probes import AGENT, SCALARS, SIZES, Aimed, Expert, Window, long_but

from cuelearner_jax.environment import spaces_of
from cuelearner_jax.errors import UserError
from cuelearner_jax.export import contract, decisions, onnx_graph, runner
from cuelearner_jax.export.graph import RULES
from cuelearner_jax.guides import registry as guidances
from cuelearner_jax.policies import Agent, Corrected, Guided, Heuristic, Opaque, layers, uniform_in

ENV = Aimed()
ANGLES = np.linspace(0.0, 6.0, 20)
DRAWN = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1).astype(np.float32)


def agent(frame="raw"):
    functions = dataclasses.replace(AGENT, directions=72).make(frame, spaces_of(ENV))
    return Agent(functions.init(jax.random.key(4))[0], functions, ENV)


def guided(kind, bound_deg=None, base=None, **sizes):
    """An untrained guide moves actions as a trained one does."""
    guidance = guidances.make(kind, dataclasses.replace(SIZES, **sizes), ENV)
    model = guidance.init(jax.random.key(5)).replace(fitted=jnp.array(True))
    bound = None if bound_deg is None else jnp.deg2rad(jnp.float32(bound_deg))
    return Guided(base or Heuristic(ENV), model, ENV, SCALARS, guidance, bound)


POLICIES = {
    "agent": agent,
    "heuristic": lambda: Heuristic(ENV),
    "refined within a bound": lambda: guided("relative", bound_deg=7.0, base=agent(frame="action"), frame="action"),
    "an ensemble": lambda: guided("demonstration", ensemble=3),
    "aims": lambda: guided("intent"),
    "a function": lambda: Opaque(lambda obs: jnp.roll(obs, 1, -1)),
}


def write(policy, format, out, drawn=DRAWN):
    return contract.write(policy, ENV, lambda: drawn, format, out, {"subject": "test"})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One decision in every format."""
    home = tmp_path_factory.mktemp("exported")
    for format in contract.FORMATS:
        write(guided("relative", bound_deg=7.0, base=agent()), format, home / format)
    return home


@pytest.mark.parametrize("name", long_but(("refined within a bound", "a function"), POLICIES))
def test_numpy_and_onnx_decide_as_jax_does(name):
    policy = POLICIES[name]()
    wanted = np.asarray(jax.jit(policy.act)(jax.random.key(0), None, jnp.asarray(DRAWN)))
    assert np.ptp(wanted, 0).max() > 0.1
    traced = decisions.trace_policy(policy, DRAWN.shape[1])
    run, (result,) = runner.compile_ops(traced.graph.ops), traced.graph.outputs
    found = []
    for obs in DRAWN:
        values = {**traced.constants, "obs": obs}
        run(values)
        found.append(np.array(values[result]))
    session = onnxruntime.InferenceSession(onnx_graph.serialize(traced, [2], [2]))
    for actions in (np.stack(found), session.run(None, {"obs": DRAWN})[0]):
        apart = np.abs(actions - wanted).max(-1)
        assert (apart <= 1e-5).mean() >= 0.9, apart  # where two values tie, either is right


def test_a_batch_of_any_size_is_decided_row_by_row(folder):
    for format in contract.FORMATS:
        decide = runner.Decision(folder / format)
        whole = decide(DRAWN)
        np.testing.assert_array_equal(decide(DRAWN[:7]), whole[:7])
        np.testing.assert_array_equal(decide(DRAWN[3]), whole[3])
        assert decide(DRAWN[:0]).shape == (0, 2)
    for wrong in (np.zeros(3), np.zeros((2, 2, 2)), [np.nan, 0.0], [1e39, 0.0], ["1.0", "0.0"], [1j, 0.0]):
        with pytest.raises(runner.ContractError, match="observation"):
            decide(wrong)


def test_the_contract_says_what_goes_in_and_what_comes_out(folder):
    told = json.loads((folder / "numpy" / runner.CONTRACT).read_text())
    (part,) = told["observation"]["slices"]
    assert part == {"name": "context", "from": 0, "to": 2, "size": 2, "unit": "1", "about": ""}
    assert told["action"]["angle"].startswith("atan2(action[1], action[0]) [rad]")
    assert "positive counterclockwise" in told["action"]["angle"]
    assert told["action"]["clip_radius_deg"] == pytest.approx(7.0)
    outer, inner = layers(told["policy"])
    assert (outer["policy"], outer["guidance"], outer["scalars"]["k_max"]) == ("guided", "relative", SCALARS.k_max)
    assert (inner["policy"], inner["agent"]["directions"], inner["frame"]) == ("agent", 72, "raw")
    assert f"jax {jax.__version__}" in told["versions"]
    for name, recorded in told["files"].items():
        assert hashlib.sha256((folder / "numpy" / name).read_bytes()).hexdigest() == recorded
    assert set(told["files"]) | {runner.CONTRACT} == {file.name for file in (folder / "numpy").glob("*.*")}


def copied(folder, tmp_path):
    """Without what Python has compiled of `decide.py` there."""
    return shutil.copytree(folder, tmp_path / "copy", ignore=shutil.ignore_patterns("__pycache__"))


def test_a_folder_that_is_damaged_or_changed_is_refused(folder, tmp_path):
    there = copied(folder / "numpy", tmp_path)
    for name in ("decision.npz", "golden.npz", "decide.py", runner.CONTRACT):
        before = (there / name).read_bytes()
        (there / name).write_bytes(before[:50] + bytes([before[50] ^ 1]) + before[51:])
        with pytest.raises(UserError, match=name):
            contract.open_decision(there)
        (there / name).write_bytes(before)
    text = (there / runner.CONTRACT).read_text()
    (there / runner.CONTRACT).write_text(text.replace('"unit": "1"', '"unit": "m"'))
    with pytest.raises(UserError, match="was changed"):
        contract.open_decision(there)
    (there / runner.CONTRACT).write_text(text)
    (there / "golden.npz").unlink()
    with pytest.raises(UserError, match=r"golden.npz cannot be read"):
        contract.open_decision(there)
    with pytest.raises(UserError, match="cannot be read"):
        contract.open_decision(tmp_path / "nowhere")


def edit_contract(folder, change=lambda contract: None):
    """Rewrite a contract by a function of its values, with the digests of the files as they are now."""
    contract = json.loads((folder / runner.CONTRACT).read_text())
    del contract[runner.DIGEST]
    change(contract)
    contract["files"] = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in contract["files"]}
    (folder / runner.CONTRACT).write_text(json.dumps({**contract, runner.DIGEST: runner.digest(contract)}))


def test_a_compiled_decision_that_calls_back_into_python_is_refused(folder, tmp_path):
    there = copied(folder / "stablehlo", tmp_path)
    exported = jax.export.deserialize(bytearray((there / "decision.stablehlo").read_bytes()))
    called = exported.mlir_module_serialized + b"xla_ffi_python_cpu_callback"  # as names of what is called stand there
    (there / "decision.stablehlo").write_bytes(dataclasses.replace(exported, mlir_module_serialized=called).serialize())
    edit_contract(there)
    with pytest.raises(UserError, match="calls Python functions"):
        contract.open_decision(there)


def test_what_this_program_cannot_run_is_told_in_one_line(folder, tmp_path):
    there = copied(folder / "stablehlo", tmp_path)
    (there / "decision.stablehlo").write_bytes((there / "decision.stablehlo").read_bytes()[:3000])
    edit_contract(there, lambda told: told["artefact"].update(jax="0.99.1"))
    with pytest.raises(UserError, match=r"exported with JAX 0\.99\.1, and JAX .* cannot call it") as refused:
        contract.open_decision(there)
    assert "\n" not in str(refused.value)
    edit_contract(there, lambda told: told.update(version=runner.VERSION + 1))
    with pytest.raises(UserError, match="newer cuelearner"):
        contract.open_decision(there)


@pytest.mark.parametrize(
    ("policy", "says"),
    [
        (lambda: uniform_in(ENV), "acts at random"),
        (lambda: guided("relative", base=uniform_in(ENV)), "acts at random"),
        (lambda: Corrected(agent(), Expert(Window()), SCALARS), "asks a teacher"),
        (lambda: Opaque(lambda obs: obs, on_host=True), "calls a Python function"),
    ],
)
def test_policies_that_no_file_can_hold_are_refused(policy, says, tmp_path):
    with pytest.raises(UserError, match=says):
        write(policy(), "numpy", tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_what_only_stablehlo_can_say_is_refused_of_the_others(tmp_path):
    policy = Opaque(lambda obs: jnp.sort(obs, -1))
    for format in ("numpy", "onnx"):
        with pytest.raises(UserError, match="does not support sort"):
            write(policy, format, tmp_path / "out")
    assert write(policy, "stablehlo", tmp_path / "out")["difference"] == 0.0


def test_differences_count_by_the_range_of_an_action_and_by_a_larger_entry_of_a_question():
    """As of a correction alone: an action in a box, then an observation for the base."""
    rows, box = np.array([[400.0, -0.01, 0.5, -30.0]]), {"name": "box", "low": [0, -0.02], "high": [500, 0.01]}
    np.testing.assert_allclose(runner.units(rows, box), [[500, 0.03, 1, 30]])
    np.testing.assert_allclose(runner.units(rows, {**box, "name": "own"}), [[400, 1, 1, 30]])


def test_golden_cases_are_those_that_rounding_does_not_turn():
    """A policy that jumps at the context (1, 0): only observations far from the jump are kept."""
    policy = Opaque(lambda obs: jnp.where(obs[:, 1:] > 0, 1.0, -1.0) * jnp.array([[0.6, 0.8]]))
    drawn = np.concatenate([np.stack([np.ones(20), np.linspace(-1e-8, 1e-8, 20)], -1), DRAWN[1:]]).astype(np.float32)
    golden = decisions.golden_cases(policy, drawn, decisions.trace_policy(policy, 2), {})
    assert golden.candidates == len(drawn)
    assert len(DRAWN) - 1 <= golden.steady <= len(DRAWN) + 8  # of the twenty near the jump, chance may leave a few
    with pytest.raises(UserError, match="change with the last digits"):
        decisions.golden_cases(policy, drawn[9:11], decisions.trace_policy(policy, 2), {})


def test_a_difference_that_no_episode_leads_to_is_noticed_when_the_file_is_written(tmp_path, monkeypatch):
    """A cast that does not saturate turns only observations above 2^31, and no drawn one is above 1."""
    policy = Opaque(lambda obs: jnp.where(obs[:, 1:].astype(jnp.int32) > 5, 1.0, -1.0) * jnp.array([[0.6, 0.8]]))
    told = write(policy, "numpy", tmp_path / "sound")
    assert told["golden"]["extreme"] > 10
    with np.load(tmp_path / "sound" / runner.GOLDEN) as golden:
        extreme = golden["obs"][-told["golden"]["extreme"] :]
    assert {np.float32(1e10), np.float32(-1e10), np.float32(1e-30), np.float32(0)} <= set(extreme[:, 0].tolist())

    def plain(builder, equation, given):
        kind = str(equation.params["new_dtype"])
        return [builder.add("cast", given, given[0].shape, kind, dtype=kind)]

    monkeypatch.setitem(RULES, "convert_element_type", plain)
    for format in ("numpy", "onnx"):
        with pytest.raises(UserError, match="golden cases differ by"):
            write(policy, format, tmp_path / "out")
    assert not (tmp_path / "out").exists()
