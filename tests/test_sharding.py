"""Training on several devices: the same as on one up to rounding; impossible numbers of devices are refused."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from tiny import CONFIG

from koz_jax import sharding, storage, trainer, training
from koz_jax.errors import UserError
from koz_jax.metrics_log import read_metrics
from koz_jax.run_folder import RunFolder

STEPS = 4

# Some steps on four devices, from the state that one device begins with; then a whole run.
TRAIN = """
import sys, pathlib
import jax, jax.numpy as jnp
from tiny import CONFIG
from koz_jax import sharding, storage, training
from koz_jax.trainer import train
assert jax.local_device_count() == 4
folder = pathlib.Path(sys.argv[1])
state = sharding.place(training.init(CONFIG, jax.random.key(0)), 4)
for _ in range(2):
    state, metrics = training.train_chunk(CONFIG, sharding.place(state, 4), jnp.int32(int(sys.argv[2])))
    for leaf in (state.buffer.rows.observation, state.buffer.rows.truncated, state.env_states.body.q_BN):
        shards = leaf.addressable_shards
        assert len({shard.device for shard in shards}) == 4
        assert sum(shard.data.size for shard in shards) == leaf.size  # divided, not copied
storage.save_tree(folder / "state", (state, metrics), {})
assert train(CONFIG, folder / "run", progress=False, devices=4) is not None
"""


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What four devices have come to."""
    folder = tmp_path_factory.mktemp("four")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_force_host_platform_device_count=4")
        done = tiny.run_python("-c", TRAIN, folder, STEPS, cwd=tiny.ROOT / "tests")
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def test_steps_on_four_devices_equal_those_on_one(four):
    state = training.init(CONFIG, jax.random.key(0))
    for _ in range(2):
        state, metrics = training.train_chunk(CONFIG, state, jnp.int32(STEPS))
    found = storage.load_tree(four / "state", jax.eval_shape(lambda: (state, metrics)))
    for (path, one), (_, other) in zip(
        jax.tree_util.tree_leaves_with_path(storage.key_data(found)),
        jax.tree_util.tree_leaves_with_path(storage.key_data((state, metrics))),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5, err_msg=jax.tree_util.keystr(path))


def test_a_run_on_four_devices_is_like_that_on_one(four):
    one, other = (read_metrics(folder / "metrics.csv") for folder in (four / "run", tiny.finished_run().path))
    assert [row["updates"] for row in one] == [row["updates"] for row in other]
    assert float(one[0]["train/critic_loss"]) == pytest.approx(float(other[0]["train/critic_loss"]), rel=1e-3)
    # Its checkpoint is one like any other.
    state = storage.load_tree(RunFolder(four / "run").checkpoints()[0], trainer._template(CONFIG))
    assert state.done == CONFIG.length


def test_impossible_numbers_of_devices_are_refused(tmp_path, capsys, monkeypatch):
    with pytest.raises(UserError, match="devices: must be from 1 to 1, the devices that there are; got 2"):
        sharding.check(CONFIG, 2)
    monkeypatch.setattr(sharding.jax, "local_devices", lambda: [None] * 3)
    with pytest.raises(UserError, match="devices: must divide num_envs = 8; got 3"):
        sharding.check(CONFIG, 3)
    for argv in (["--devices", 0], ["--devices", 2, "--seeds", 2]):
        assert tiny.status("train", *argv, "--run", tmp_path / "run") == 2
        assert "devices: must be 1 or more, and 1 with --seeds" in capsys.readouterr().err
