"""Parsing and printing of layer names."""

from __future__ import annotations

import pytest

from pnpdepth_cli.core.split.cut_point import LayerName
from pnpdepth_cli.errors import LayerError


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("decoder.up1", LayerName("decoder.up1")),
        ("relu#2", LayerName("relu", 2)),
        ("a.b[x]", LayerName("a.b", None, ("x",))),
        ("a[hidden_states][3]", LayerName("a", None, ("hidden_states", "3"))),
        ("a#12[0]", LayerName("a", 12, ("0",))),
    ],
)
def test_a_name_has_its_parts(text: str, name: LayerName) -> None:
    assert LayerName.parse(text) == name


@pytest.mark.parametrize("text", ["a#", "a#0", "a#-1", "a#1#2", "a[", "a[]", "a]", "a[0]#2"])
def test_another_form_is_refused(text: str) -> None:
    with pytest.raises(LayerError, match="the form is"):
        LayerName.parse(text)


def test_an_outputs_name_is_read_back() -> None:
    name = LayerName("encoder.stage")
    assert LayerName.parse(name.of_output(("out", "1"))) == LayerName(
        "encoder.stage", None, ("out", "1")
    )
