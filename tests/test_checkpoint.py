"""Checkpoints: what is written comes back, loading runs nothing, and what does not fit is refused in one line."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

torch = pytest.importorskip("torch")

from tiny_network import tiny_settings  # noqa: E402

from augkitti.errors import InputError, MachineError  # noqa: E402
from training.checkpoint import (  # noqa: E402
    FORMAT,
    NAME,
    Checkpoint,
    check_fits,
    export,
    fill,
    load_checkpoint,
    network_of,
    random_states,
    save_checkpoint,
    set_random_states,
)
from training.cli import app  # noqa: E402
from training.network import PointFlowNet  # noqa: E402

SETTINGS = tiny_settings()


def made() -> tuple[PointFlowNet, Checkpoint]:
    """A network after one step, and all of its run."""
    torch.manual_seed(0)
    network = PointFlowNet(SETTINGS)
    optimiser = torch.optim.AdamW(network.parameters())
    sum(p.square().sum() for p in network.parameters()).backward()
    optimiser.step()
    reader = {"epoch": 2, "pairs_done": 40, "seed": 2**60, "digest": "abc"}
    weights = dict(network.state_dict())
    facts = {"steps": 100, "note": "ü"}
    return network, Checkpoint(SETTINGS, weights, 7, "abc", optimiser.state_dict(), random_states(), reader, facts)


def one_line(error: pytest.ExceptionInfo) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


def test_all_that_is_written_comes_back(tmp_path):
    network, checkpoint = made()
    save_checkpoint(tmp_path / "run" / NAME, checkpoint)
    back = load_checkpoint(tmp_path / "run")
    assert (back.settings, back.step, back.data_digest) == (SETTINGS, 7, "abc")
    assert (back.reader, back.facts) == (checkpoint.reader, checkpoint.facts)
    for name, value in network.state_dict().items():
        assert back.weights[name].equal(value), name
    other = torch.optim.AdamW(network.parameters())
    other.load_state_dict(back.optimiser)
    for number, state in checkpoint.optimiser["state"].items():
        assert all(other.state_dict()["state"][number][key].equal(value) for key, value in state.items())
    assert not list((tmp_path / "run").glob("*.tmp"))


def test_a_checkpoint_holds_tensors_numbers_and_text_only(tmp_path):
    save_checkpoint(tmp_path / NAME, made()[1])
    content = torch.load(tmp_path / NAME, weights_only=True)
    assert {"weights", "optimiser", "step", "settings", "data_digest", "random", "reader", "format"} <= set(content)


def test_what_would_run_code_is_refused(tmp_path):
    class Evil:
        def __reduce__(self):
            return (print, ("run",))

    torch.save({"format": FORMAT, "weights": Evil()}, tmp_path / NAME)
    with pytest.raises(InputError, match="not readable as a checkpoint") as error:
        load_checkpoint(tmp_path)
    one_line(error)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "not readable"),
        (b"PK\x03\x04 and then nothing", "not readable"),
        ([1, 2], "not a checkpoint of this program"),
        ({"format": FORMAT + 1}, f"has checkpoint format {FORMAT + 1}"),
        ({"format": FORMAT}, "not a whole checkpoint"),
        ({"format": FORMAT, "settings": '{"grid": {"x_m": 3}}', "digest": ""}, "not a whole checkpoint"),
        ({"format": FORMAT, "settings": "{}", "digest": "other"}, "do not fit its digest"),
    ],
)
def test_what_is_no_checkpoint_is_told_in_one_line(tmp_path, content, problem):
    file = tmp_path / NAME
    file.write_bytes(content) if isinstance(content, bytes) else torch.save(content, file)
    with pytest.raises(InputError, match=problem) as error:
        load_checkpoint(tmp_path)
    assert str(file) in one_line(error)


def test_a_truncated_checkpoint_is_told_in_one_line(tmp_path):
    save_checkpoint(tmp_path / NAME, made()[1])
    whole = (tmp_path / NAME).read_bytes()
    (tmp_path / NAME).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="not readable as a checkpoint") as error:
        load_checkpoint(tmp_path)
    one_line(error)


def test_a_run_that_is_not_there_is_told_in_one_line(tmp_path):
    with pytest.raises(InputError, match="does not exist") as error:
        load_checkpoint(tmp_path)
    one_line(error)


def test_a_checkpoint_of_another_config_is_refused_in_one_line(tmp_path):
    _, checkpoint = made()
    wider = SETTINGS.model_copy(update={"network": SETTINGS.network.model_copy(update={"upsampled": 8})})
    with pytest.raises(InputError, match="of another network or grid than --config") as error:
        check_fits(checkpoint, wider, "abc", tmp_path)
    one_line(error)
    faster = SETTINGS.model_copy(update={"train": SETTINGS.train.model_copy(update={"learning_rate": 1.0})})
    with pytest.raises(InputError, match="made with other settings: train;") as error:
        check_fits(checkpoint, faster, "abc", tmp_path)
    one_line(error)
    with pytest.raises(InputError, match="trained on other shards") as error:
        check_fits(checkpoint, SETTINGS, "xyz", tmp_path)
    one_line(error)
    with pytest.raises(InputError, match="holds weights only"):
        check_fits(replace(checkpoint, optimiser=None), SETTINGS, "abc", tmp_path)
    check_fits(checkpoint, SETTINGS, "abc", tmp_path)


def test_weights_of_another_network_are_refused_in_one_line():
    _, checkpoint = made()
    wider = SETTINGS.model_copy(update={"network": SETTINGS.network.model_copy(update={"upsampled": 8})})
    with pytest.raises(InputError, match="has other layers than this program's network: object_decoder") as error:
        network_of(replace(checkpoint, settings=wider), "run")
    one_line(error)
    with pytest.raises(InputError, match="feature_encoder"):
        fill(PointFlowNet(SETTINGS), {n: w for n, w in checkpoint.weights.items() if "feature" not in n}, "run")


def test_an_exported_network_is_half_as_large_and_says_nearly_the_same(tmp_path, capsys):
    network, checkpoint = made()
    save_checkpoint(tmp_path / NAME, checkpoint)
    export(tmp_path, tmp_path / "small.pt")
    assert "7 steps" in capsys.readouterr().out
    assert (tmp_path / "small.pt").stat().st_size < 0.5 * (tmp_path / NAME).stat().st_size
    back = load_checkpoint(tmp_path / "small.pt")
    assert back.optimiser is None
    assert back.facts["steps_done"] == 7
    for name, value in network_of(back).state_dict().items():
        torch.testing.assert_close(value, network.state_dict()[name], rtol=1e-3, atol=1e-6)
        assert value.dtype in (torch.float32, torch.int64)


def test_random_numbers_go_on_where_they_stood():
    rng = np.random.default_rng(3)
    rng.random(5)
    states = random_states(rng)
    drawn = torch.rand(4), rng.random(4)
    set_random_states(states, rng)
    assert torch.rand(4).equal(drawn[0])
    np.testing.assert_array_equal(rng.random(4), drawn[1])


def test_a_disk_that_refuses_is_told_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MachineError, match="cannot be written") as error:
        save_checkpoint(tmp_path / "file" / NAME, made()[1])
    one_line(error)


def test_the_command_exports_a_run_and_tells_one_that_is_not_there(tmp_path):
    save_checkpoint(tmp_path / "run" / NAME, made()[1])
    out = str(tmp_path / "small.pt")
    assert CliRunner().invoke(app, ["export", str(tmp_path / "run"), "--out", out]).exit_code == 0
    assert load_checkpoint(tmp_path / "small.pt").step == 7
    said = CliRunner().invoke(app, ["export", str(tmp_path / "none"), "--out", out])
    assert said.exit_code == 2
    assert said.stderr.splitlines() == [said.stderr.strip()]
