"""Settings: what is read, what is refused, and in which words."""

import math
from dataclasses import dataclass, field
from typing import Literal, Optional

import pytest
import yaml

from jprimfit.settings import differences, from_mapping, read_yaml, to_mapping, with_overrides


@dataclass(frozen=True)
class Opt:
    lr: float = 1e-3
    schedule: Literal["staircase", "cosine"] = "staircase"
    clip_norm: float | None = None
    levels: Literal[1, 2] = 1

    def __post_init__(self):
        if self.lr <= 0:
            raise ValueError(f"lr must be above 0, but is {self.lr}")


@dataclass(frozen=True)
class Model:
    widths: tuple[int, ...] = (64, 128)
    window: tuple[float, float] = (0.0, 1.0)
    nested: tuple[tuple[int, ...], ...] = ()
    name: str = "a"


@dataclass(frozen=True)
class Root:
    file: str
    opt: Opt = field(default_factory=Opt)
    model: Model = Model()
    steps: Optional[int] = None  # noqa: UP045
    debug: bool = False


def load(**mapping):
    return from_mapping(Root, {"file": "x.h5", **mapping}, source="c.yaml")


def test_values_come_in_the_annotated_types():
    config = load(
        opt={"lr": "1e-3", "schedule": "cosine", "clip_norm": 5},
        model={"widths": [1, "2"], "window": [0, math.inf], "nested": [[1], []]},
        steps="1e5",
        debug=True,
    )
    assert config == Root(
        "x.h5", Opt(1e-3, "cosine", 5.0), Model((1, 2), (0.0, math.inf), ((1,), ())), 100_000, debug=True
    )
    assert isinstance(config.opt.clip_norm, float) and isinstance(config.steps, int)
    assert load(opt=None, steps=None) == Root("x.h5")
    assert hash(config) == hash(load(**to_mapping(config)))


@pytest.mark.parametrize(
    ("mapping", "sentence"),
    [
        ({"opt": {"lrr": 1}}, "unknown key 'opt.lrr' in c.yaml, did you mean 'opt.lr'?"),
        ({"optt": {"lr": 1}}, "unknown key 'optt' in c.yaml, did you mean 'opt'?"),
        ({"schedule": "cosine"}, "unknown key 'schedule' in c.yaml, did you mean 'opt.schedule'?"),
        ({"qqq": 1}, "unknown key 'qqq' in c.yaml; known are file, opt, model, steps, debug."),
        ({"opt": {"lr": "fast"}}, "opt.lr in c.yaml is 'fast'; expected a float."),
        ({"opt": {"lr": True}}, "opt.lr in c.yaml is True; expected a float."),
        ({"opt": {"lr": float("nan")}}, "opt.lr in c.yaml is nan; expected a float."),
        ({"opt": {"lr": 0}}, "c.yaml: opt: lr must be above 0, but is 0.0"),
        ({"opt": {"lr": None}}, "opt.lr in c.yaml is None; expected a float."),
        ({"opt": 3}, "opt in c.yaml is 3; expected a section, that is lines of `key: value`."),
        (
            {"opt": {"schedule": "cosin"}},
            "opt.schedule in c.yaml is 'cosin'; expected one of staircase, cosine; did you mean 'cosine'?",
        ),
        ({"opt": {"levels": True}}, "opt.levels in c.yaml is True; expected one of 1, 2."),
        ({"steps": 1.5}, "steps in c.yaml is 1.5; expected an int or null."),
        ({"debug": 1}, "debug in c.yaml is 1; expected a bool (true or false)."),
        ({"model": {"name": 7}}, "model.name in c.yaml is 7; expected text."),
        ({"model": {"widths": 5}}, "model.widths in c.yaml is 5; expected a list [...] in which each item is an int."),
        ({"model": {"widths": [1, "a"]}}, "model.widths[1] in c.yaml is 'a'; expected an int."),
        ({"model": {"window": [1]}}, "model.window in c.yaml is [1]; expected a list [float, float]."),
    ],
)
def test_what_is_wrong_is_named_with_its_place(mapping, sentence):
    with pytest.raises(ValueError) as caught:
        load(**mapping)
    assert str(caught.value) == sentence


def test_a_key_without_default_must_be_given():
    with pytest.raises(ValueError, match="c.yaml lacks the key 'file': give it text"):
        from_mapping(Root, {}, source="c.yaml")


def test_overrides_reach_into_sections_and_leave_the_original_alone():
    mapping = {"opt": {"lr": 1}, "steps": 3, "model": None}
    changed = with_overrides(mapping, ["opt.lr=1e-3", "model.widths=[1, 2]", "steps=null", "new.a.b=x=y", "opt.lr=2"])
    assert changed == {
        "opt": {"lr": 2},
        "model": {"widths": [1, 2]},
        "steps": None,
        "new": {"a": {"b": "x=y"}},
    }
    assert mapping == {"opt": {"lr": 1}, "steps": 3, "model": None}


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("train", "'train' is no setting; expected section.key=value"),
        ("=3", "'=3' is no setting"),
        ("a..b=3", "'a..b=3' is no setting"),
        ("steps.a=3", "'steps.a=3' cannot be set: steps is 3, not a section"),
        ("a=[1", "the value of 'a=[1' cannot be read as YAML"),
    ],
)
def test_an_override_that_means_nothing_is_refused(override, sentence):
    with pytest.raises(ValueError) as caught:
        with_overrides({"steps": 3}, [override])
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (b"a: 1\nb: [1\n", "cannot be read as YAML"),
        (b"a: 1\nb: 2\na: 3\n", "the key 'a' stands twice in line 3"),
        (b"c:\n  a: 1\n  a: 3\n", "the key 'a' stands twice in line 3"),
        (b"1: 2\n", "the key 1 is no name in line 1"),
        (b"- 1\n", "is [1]; expected a section"),
        (b"a: !!python/object/apply:os.getcwd []\n", "cannot be read as YAML"),
        (b"\xff\xfe\x00", "is not a text file"),
    ],
)
def test_a_file_that_is_no_settings_is_refused(tmp_path, text, sentence):
    (tmp_path / "c.yaml").write_bytes(text)
    with pytest.raises(ValueError) as caught:
        read_yaml(tmp_path / "c.yaml")
    assert sentence in str(caught.value) and "c.yaml" in str(caught.value)


def test_settings_survive_a_file(tmp_path):
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    assert read_yaml(tmp_path / "empty.yaml") == {}
    config = load(opt={"lr": 1e-5}, model={"window": [0, math.inf], "nested": [[1, 2]]})
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(to_mapping(config)))
    assert from_mapping(Root, read_yaml(tmp_path / "c.yaml"), source="c.yaml") == config


def test_differences_are_dotted_keys():
    first, second = load(), load(opt={"lr": 2.0}, model={"widths": [1]}, steps=4)
    assert differences(first, second) == ["opt.lr", "model.widths", "steps"]
    assert differences(first, to_mapping(first)) == []
    assert differences({"a": {"b": 1}, "c": {}}, {"a": {"d": 1}}) == ["a.b", "c", "a.d"]
