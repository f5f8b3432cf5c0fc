"""The call stack between the command line and one loss stays shallow."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from detectors.squeezedet import SqueezeDet
from drivesem.cli import main

MAX_DEPTH = 14
"""Frames from `main` to the detector's loss, both included."""
MAX_GRADIENT_FUNCTIONS = 3
"""Functions of drivesem between an attack's step and the detector's loss."""


def call_stack(frame: FrameType | None) -> list[str]:
    """Names of the functions on the stack, innermost first, up to `main`."""
    names: list[str] = []
    while frame is not None and names[-1:] != ["main"]:
        names.append(frame.f_code.co_name)
        frame = frame.f_back
    return names


def test_few_calls_lie_between_the_command_and_a_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stacks: list[list[str]] = []
    original = SqueezeDet.loss

    def loss(self: SqueezeDet, *arguments: Any, **options: Any) -> Any:
        stacks.append(call_stack(sys._getframe(1)))
        return original(self, *arguments, **options)

    monkeypatch.setattr(SqueezeDet, "loss", loss)
    words = ["attack", "--limit", "1", "--workers", "1", "--combo", "1", "--steps", "1", "--no-grade"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    gradients = [stack for stack in stacks if "loss_and_grad" in stack]
    assert gradients
    for stack in gradients:
        assert stack[-1] == "main"
        assert len(stack) + 1 <= MAX_DEPTH, stack
        assert stack.index("propose") <= MAX_GRADIENT_FUNCTIONS, stack
