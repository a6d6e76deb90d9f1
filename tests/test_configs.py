from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from dejavu_torch import DejaVu
from dejavu_torch.cli.parser import MODEL, build_parser
from dejavu_torch.database.mapfile import recipe_of
from dejavu_torch.experiments.reproduce import paper_model

CONFIGS = Path(__file__).parents[1] / "configs"


def model_of(name: str) -> DejaVu:
    parser = build_parser()
    parsed = parser.parse_args(["learn", "x", "--map", "y", "--config", str(CONFIGS / name)])
    chosen = parser.instantiate(parsed)["learn"]
    return DejaVu(**{name: chosen[name] for name in MODEL})


def settings(model: DejaVu) -> dict[str, object]:
    return {
        "features": recipe_of(model.features),
        "periods": recipe_of(model.periods),
        "matcher": (model.matcher.metric, model.matcher.reduction, model.matcher.temperature),
        "threshold": model.threshold,
        "batch_size": model.batch_size,
    }


def test_default_yaml_is_the_constructors_defaults() -> None:
    assert settings(model_of("default.yaml")) == settings(DejaVu())


@pytest.mark.parametrize("name", ["default.yaml", "paper.yaml"])
def test_presets_spell_out_every_argument(name: str) -> None:
    written = yaml.safe_load((CONFIGS / name).read_text())
    model = model_of(name)
    assert set(written) == set(MODEL)
    for part in ("features", "periods"):
        assert written[part]["init_args"] == recipe_of(getattr(model, part)).init_args


def test_convention_3_paper_yaml_is_the_letter() -> None:
    model = model_of("paper.yaml")
    letter = {
        "window": 1024,
        "hop": None,
        "min_period": 8,
        "strongest": 2,
        "peaks": "bins",
        "false_alarm": None,
        "similar": 0.0,
        "short": "refuse",
    }
    assert recipe_of(model.periods).init_args == letter
    assert model.matcher.reduction == "sum"
    assert model.matcher.metric == "l1"
    assert model.matcher.temperature is None


def test_reproduce_uses_the_papers_letter() -> None:
    assert settings(paper_model()) == settings(model_of("paper.yaml"))
