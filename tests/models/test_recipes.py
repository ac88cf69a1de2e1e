"""Recipes: those of the paper's tables, and what is said to a mistake in one's own."""

from dataclasses import asdict
from itertools import product

import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.recipes import load_recipe, read_recipe, shipped_recipes
from tests.helpers.refusals import refusal

E4 = [0.1, 0.01, 0.001, 0.0001]
GATED = {"zhuang-ugrnn", "zhuang-intersection", "zhuang-gru", "zhuang-lstm"}
ZHUANG = {f"zhuang-{cell}" for cell in ("timedecay", "ugrnn", "intersection-ln", "gru", "lstm")}
WITH_GPT = {"resnet18", "s4", *ZHUANG}
WITH_MAMBA = {"resnet18", "zhuang-timedecay", "s4"}

# Table A3: name: (encoders, attender, optimizers, schedule, rates)
SUPERVISED = {
    "paper-resnet": ({"resnet18"}, "none", {"sgd"}, "step", E4[:3]),
    "paper-zhuang-step": ({"zhuang-timedecay"}, "none", {"sgd"}, "step", E4),
    "paper-zhuang-constant": ({"zhuang-timedecay"}, "none", {"sgd"}, "constant", [0.01, 0.005]),
    "paper-gated": (GATED, "none", {"sgd", "adam", "adamw"}, "step", E4),
    "paper-gated-ln": (
        {f"{e}-ln{'-published' * (e == 'zhuang-lstm')}" for e in GATED},
        "none",
        {"adamw"},
        "step",
        E4,
    ),
    "paper-gpt-cosine": (WITH_GPT, "gpt", {"adamw"}, "cosine", [1e-4]),
    "paper-gpt-step": (WITH_GPT, "gpt", {"sgd", "adamw"}, "step", E4[:3]),
    "paper-mamba-cosine": (WITH_MAMBA, "mamba", {"adamw"}, "cosine", [1e-4]),
    "paper-mamba-step": (WITH_MAMBA, "mamba", {"sgd", "adamw"}, "step", E4[:3]),
}
# Table A4: loss: (optimizer, schedule, warm-up, batch); Table A5: attender: encoders
LOSSES = {
    "simclr": ("lars-paper", "cosine-annealing", 0.1, 256),
    "simsiam": ("sgd", "cosine-annealing", 0.0, 1024),
    "simsiam-warmup": ("sgd", "cosine-annealing", 0.1, 1024),
    "autoencoder": ("sgd", "step", None, 256),
}
NETWORKS = {
    "none": ZHUANG,
    "gpt": {"resnet18", "zhuang-intersection-ln", "zhuang-timedecay", "s4"},
    "mamba": WITH_MAMBA,
}


def choices(recipe, key):
    return recipe.search.get(key, [recipe.train[key]])


@pytest.mark.parametrize("name", shipped_recipes())
def test_every_combination_of_a_recipe_names_a_network(name):
    recipe = load_recipe(name)
    assert recipe.about
    for together in product(*recipe.search.values()):
        values = dict(zip(recipe.search, together, strict=True))
        recipe.config("set", **values).network(classes=117)
        assert set(values) <= set(recipe.train)
    for key, values in recipe.search.items():
        assert values[0] == recipe.train[key]


def test_the_default_recipe_is_the_default():
    assert read_recipe("default", "set") == TrainingConfig("set")


@pytest.mark.parametrize("name", SUPERVISED)
def test_supervised_recipes_are_those_of_the_table(name):
    encoders, attender, optimizers, schedule, rates = SUPERVISED[name]
    recipe = load_recipe(name)
    config = recipe.config("set")
    assert set(choices(recipe, "encoder")) == encoders
    assert set(choices(recipe, "optimizer")) == optimizers
    assert sorted(choices(recipe, "learning_rate"), reverse=True) == rates
    assert (config.attender, config.schedule) == (attender, schedule)
    assert config.objective == "supervised"
    assert (config.batch, config.epochs, config.weight_decay) == (256, 100, 1e-4)
    assert (config.width, config.readout, config.loss) == (1, "last", "last")
    assert config.schedule != "cosine" or config.warmup * config.epochs == 10
    assert config.drop_every * config.epochs == 30


@pytest.mark.parametrize("attender", NETWORKS)
@pytest.mark.parametrize("loss", LOSSES)
def test_self_supervised_recipes_are_those_of_the_tables(loss, attender):
    optimizer, schedule, warmup, batch = LOSSES[loss]
    recipe = load_recipe(f"paper-{loss}" + (f"-{attender}" if attender != "none" else ""))
    config = recipe.config("set")
    assert set(choices(recipe, "encoder")) == NETWORKS[attender]
    assert sorted(choices(recipe, "learning_rate"), reverse=True) == E4
    assert config.attender == attender
    assert config.objective == loss.removesuffix("-warmup")
    assert (config.optimizer, config.schedule, config.batch) == (optimizer, schedule, batch)
    assert warmup is None or config.warmup == warmup
    assert config.augmentation == ("none" if loss == "autoencoder" else "tactile-paper")


def test_overrides_come_last():
    config = read_recipe("paper-simclr", "set", width=0.125, encoder="gru")
    assert (config.width, config.encoder, config.objective) == (0.125, "gru", "simclr")
    rest = {k: v for k, v in asdict(config).items() if k not in ("width", "encoder")}
    whole = asdict(read_recipe("paper-simclr", "set"))
    assert rest == {k: v for k, v in whole.items() if k in rest}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[train]\nlerning_rate = 1.0",
            "train has no key 'lerning_rate'; did you mean learning_rate?",
        ),
        ("[search]\noptimizer = ['sgd', 'sdg']", "optimizer is 'sdg', not one of"),
        ("[train]\nencoder = 'foo'", ":1: encoder is 'foo', not one of"),
        (
            "[train]\n\n[search]\nlearning_rate = [0.1, -1.0]",
            ":3: train: learning_rate must be positive",
        ),
        ("[train]\ndata = 'set'", "train has no key 'data'"),
    ],
)
def test_a_mistake_is_one_line_that_names_file_and_key(tmp_path, text, said):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    found = refusal(read_recipe, str(path), "set")
    assert str(path) in found and said in found


def test_a_recipe_that_is_not_there(tmp_path):
    with pytest.raises(ConfigError, match="no recipe 'paper-simclar'; did you mean paper-simclr"):
        read_recipe("paper-simclar", "set")
    assert "none.toml: no such file" in refusal(read_recipe, str(tmp_path / "none.toml"), "set")
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe")
    assert "not UTF-8 text" in refusal(read_recipe, str(tmp_path / "b.toml"), "set")
