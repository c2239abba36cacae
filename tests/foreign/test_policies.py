"""Policies of PyTorch, Stable-Baselines3 and onnxruntime act as themselves; faults are told in one line."""

import jax
import numpy as np
import pytest

from cuelearner_jax.errors import UserError
from cuelearner_jax.policies import policy_of
from cuelearner_jax.spaces import Box, Choices

FIRST = np.eye(3, 2)  # a policy whose action is the first two entries of its observation
SPACE = Box((-1.0, -1.0), (1.0, 1.0))
OBS = np.random.default_rng(0).uniform(-1, 1, (5, 3)).astype(np.float32)


def acted(given, obs=OBS, space=SPACE):
    """What a policy does in a compiled program."""
    policy = policy_of(given, space)
    return np.asarray(jax.jit(lambda obs: policy.act(jax.random.key(0), None, obs))(obs))


def fault(given, obs=OBS, space=SPACE):
    """What is told of a policy, in one line."""
    from cuelearner_jax.api.policies import CallablePolicy

    with pytest.raises(UserError) as error:
        CallablePolicy(policy_of(given, space), actions=space)(obs)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.fixture
def torch():
    return pytest.importorskip("torch")


pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")


def network(torch, outputs=2, dtype=None):
    """A small network with dropout, which acts at random unless it is in evaluation mode."""
    torch.manual_seed(0)
    parts = torch.nn.Linear(3, 8), torch.nn.Tanh(), torch.nn.Dropout(0.5), torch.nn.Linear(8, outputs), torch.nn.Tanh()
    return torch.nn.Sequential(*parts).to(dtype or torch.float32)


def test_a_module_acts_in_evaluation_mode_and_keeps_its_own(torch):
    module = network(torch).train()
    module[0].eval()
    found = acted(module)
    assert [part.training for part in module] == [False, True, True, True, True]
    with torch.no_grad():
        np.testing.assert_allclose(found, module.eval()(torch.as_tensor(OBS)).numpy(), atol=1e-6)
    assert all(own.grad is None for own in module.parameters())


def test_faults_of_modules_are_told(torch):
    class Broken(torch.nn.Module):
        def forward(self, obs):
            return obs[:, :2] / 0 * 0

    assert "not finite" in fault(Broken())
    assert "returned actions of shape (1, 3) for 1 observations: return (1, 2)" in fault(network(torch, 3))
    assert "RuntimeError" in fault(network(torch), OBS[:, :2])


def deployed(torch, how):
    """A module as it is deployed, without training mode or `eval`, and its actions."""
    module = network(torch).eval()
    script = torch.jit.script(module)
    if how == "exported":
        many = ({0: torch.export.Dim("n")},)
        return module, torch.export.export(module, (torch.zeros(2, 3),), dynamic_shapes=many).module()
    return module, torch.jit.freeze(script) if how == "frozen" else torch.jit.optimize_for_inference(script)


@pytest.mark.parametrize("how", ["frozen", "optimised", "exported"])
def test_deployed_modules_act(how, torch):
    module, given = deployed(torch, how)
    np.testing.assert_allclose(acted(given), acted(module), atol=1e-6)


@pytest.fixture
def gymnasium():
    pytest.importorskip("stable_baselines3")
    return pytest.importorskip("gymnasium")


def env_of(gymnasium, space, actions):
    """An environment of one step with these spaces."""

    class One(gymnasium.Env):
        observation_space, action_space = space, actions

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), 0.0, True, False, {}

    return One()


def model_of(kind, policy, env, **more):
    """An untrained model."""
    size = {"buffer_size": 10} if kind.__name__ in ("SAC", "DQN") else {"n_steps": 2, "batch_size": 2}
    return kind(policy, env, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu", **size, **more)


def test_a_model_of_stable_baselines3_acts_deterministically(gymnasium):
    from stable_baselines3 import PPO

    box = gymnasium.spaces.Box
    model = model_of(PPO, "MlpPolicy", env_of(gymnasium, box(-1, 1, (3,)), box(-1, 1, (2,))))
    wanted = model.predict(OBS, deterministic=True)[0]
    for given in (model, model.predict, model.policy, lambda obs: model.predict(obs, deterministic=True)):
        np.testing.assert_allclose(acted(given), wanted, atol=1e-6)
    assert fault(model, OBS[:, :2]).startswith("policy PPO takes observations of 3 entries, these have 2")
    assert "does not repeat itself" in fault(lambda obs: model.predict(obs, deterministic=False))
    with pytest.raises(UserError, match=r"gives actions between \(-1, -1\) and \(1, 1\), this world takes .* \(2, 1\)"):
        acted(model, space=Box((-1.0, -1.0), (2.0, 1.0)))


def test_a_model_sees_observations_normalised_as_in_its_training(gymnasium):
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    box = gymnasium.spaces.Box
    env = VecNormalize(DummyVecEnv([lambda: env_of(gymnasium, box(4, 5, (3,)), box(-1, 1, (2,)))]))
    model = model_of(PPO, "MlpPolicy", env).learn(20)
    wanted = model.predict(env.normalize_obs(OBS), deterministic=True)[0]
    assert np.abs(wanted - model.predict(OBS, deterministic=True)[0]).max() > 0.01
    np.testing.assert_allclose(acted(model), wanted, atol=1e-6)


def test_a_model_of_dictionaries_takes_rows_in_the_order_of_its_keys(gymnasium):
    from stable_baselines3 import PPO

    spaces = gymnasium.spaces
    seen = {"pose": spaces.Box(-1, 1, (2,)), "goal": spaces.Box(-1, 1, (1,)), "tool": spaces.Discrete(3)}
    model = model_of(PPO, "MultiInputPolicy", env_of(gymnasium, spaces.Dict(seen), spaces.Box(-1, 1, (2,))))
    tools = np.array([0, 2, 1, 1, 0])
    values = {"pose": OBS[:, :2], "goal": OBS[:, 2:], "tool": tools}
    rows = np.concatenate([np.eye(3)[tools] if key == "tool" else values[key] for key in model.observation_space], 1)
    np.testing.assert_allclose(acted(model, rows), model.predict(values, deterministic=True)[0], atol=1e-6)


def test_a_model_takes_places_from_rows_and_gives_choices_by_their_places(gymnasium):
    from stable_baselines3 import DQN, PPO

    spaces, places = gymnasium.spaces, np.arange(5)
    env = env_of(gymnasium, spaces.Discrete(5), spaces.Discrete(4))
    for model in (model_of(DQN, "MlpPolicy", env), model_of(PPO, "MlpPolicy", env)):
        found = acted(model, np.eye(5, dtype=np.float32), Choices(4))
        np.testing.assert_array_equal(found, np.eye(4)[model.predict(places, deterministic=True)[0]])
    with pytest.raises(UserError, match="that are one of 4 choices, this world takes actions that are one of 3"):
        acted(model, np.eye(5, dtype=np.float32), Choices(3))
    env = env_of(gymnasium, spaces.MultiDiscrete([2, 3]), spaces.Discrete(4))
    model = model_of(PPO, "MlpPolicy", env)
    found = acted(model, np.float32([[0, 1, 1, 0, 0]]), Choices(4))
    np.testing.assert_array_equal(found, np.eye(4)[model.predict(np.array([[1, 0]]), deterministic=True)[0]])


@pytest.fixture
def stored(tmp_path):
    """Writes a file in ONNX: obs (rows, size) times a matrix, under these names."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper, real = onnx.helper, onnx.TensorProto.FLOAT

    def write(rows="n", outputs=("action",), inputs=("obs",), matrix=FIRST):
        weights = onnx.numpy_helper.from_array(matrix.astype(np.float32), "w")
        nodes = [helper.make_node("MatMul", [inputs[0], "w"], [name]) for name in outputs]
        given = [helper.make_tensor_value_info(name, real, [rows, 3]) for name in inputs]
        made = [helper.make_tensor_value_info(name, real, [rows, 2]) for name in outputs]
        graph = helper.make_graph(nodes, "policy", given, made, [weights])
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)])
        model.ir_version = 8
        path = tmp_path / "policy.onnx"
        path.write_bytes(model.SerializeToString())
        return path

    return write


@pytest.mark.parametrize("rows", ["n", 1])
def test_a_file_in_onnx_acts(rows, stored):
    path = stored(rows)
    np.testing.assert_allclose(acted(path), OBS[:, :2])
    np.testing.assert_allclose(acted(str(path)), OBS[:, :2])


def test_files_in_onnx_that_do_not_fit_are_told(stored, tmp_path):
    with pytest.raises(UserError, match="has the outputs mean, value"):
        policy_of(stored(outputs=("mean", "value")))
    with pytest.raises(UserError, match=r"has the inputs obs tensor\(float\)"):
        policy_of(stored(inputs=("obs", "mask")))
    (tmp_path / "damaged.onnx").write_bytes(b"no model")
    with pytest.raises(UserError, match="cannot be run by onnxruntime"):
        policy_of(tmp_path / "damaged.onnx")
    with pytest.raises(UserError, match=r"reading .*model.zip may run code in it.* give my_policy:POLICY"):
        policy_of(tmp_path / "model.zip")
    assert "Got: 2 Expected: 3" in fault(stored(), OBS[:, :2])
    assert "not finite" in fault(stored(matrix=np.full((3, 2), np.nan)))
