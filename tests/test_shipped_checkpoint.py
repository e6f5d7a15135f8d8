"""The checkpoint that comes with the program: it is small, loads without pickle, and finds cars it has not seen."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from training.checkpoint import load_checkpoint, shipped_checkpoint  # noqa: E402
from training.config import load_settings  # noqa: E402


def test_the_shipped_checkpoint_is_small_and_of_the_small_network():
    file = shipped_checkpoint()
    assert file.stat().st_size <= 3_000_000
    shipped = load_checkpoint(file)
    assert shipped.settings.digest() == load_settings("small").digest()
    assert shipped.step == shipped.facts["steps_done"] == shipped.facts["steps"]
    assert all(bool(torch.isfinite(weight).all()) for weight in shipped.weights.values())


def test_the_shipped_network_foretells_an_embedded_street_better_than_no_motion(tmp_path):
    from typer.testing import CliRunner

    from pipelines.cli import app
    from training.evaluate import EvaluateOptions, evaluate

    made = CliRunner().invoke(
        app, ["generate", "--n", "2", "--seed", "77", "--out", str(tmp_path / "aug")], env={"AUGKITTI_KITTI": ""}
    )
    assert made.exit_code == 0, made.output
    rows = {row["method"]: row for row in evaluate(EvaluateOptions(None, (tmp_path / "aug",), split=None)).rows}
    for name in ("fg_epe", "bg_epe", "ego_tr"):
        assert np.isfinite(rows["direct"][name])
        assert rows["direct"][name] < 0.7 * rows["zero"][name]
