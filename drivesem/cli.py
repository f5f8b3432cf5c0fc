"""`drivesem COMMAND [options]`: parses, hands over to the command, turns errors into one line and exit code 2."""

from __future__ import annotations

import contextlib
import io
import re
import sys
from collections.abc import Sequence

import tyro

from drivesem.config import (
    COMMANDS,
    Anchors,
    Attack,
    Bench,
    Check,
    Command,
    Confirm,
    Convert,
    Derender,
    Edit,
    Eval,
    Explain,
    Gradcheck,
    Plausibility,
    Realism,
    Render,
    Report,
    Retrain,
    Study,
    Survey,
    SurveyResults,
    Synth,
    Train,
    Transfer,
    UsageError,
    Verify,
    Worth,
    validate,
    yaml_arguments,
)
from drivesem.folder_lock import let_go

_DESCRIPTION = "Find out where a driving detector breaks: semantic counterexamples by gradient."
_EXIT_BAD_INPUT = 2
_EXIT_INTERRUPTED = 130


def parse(argv: Sequence[str]) -> Command:
    """The configuration that `argv` asks for. Raises UsageError; SystemExit(0) after `--help`."""
    words = list(argv)
    if words and words[0] in COMMANDS:
        words = [words[0], *_with_presets(words[0], words[1:])]
    captured = io.StringIO()
    try:
        with contextlib.redirect_stderr(captured):
            config: Command = tyro.extras.subcommand_cli_from_dict(  # pyright: ignore[reportAssignmentType]
                COMMANDS, prog="drivesem", description=_DESCRIPTION, args=words
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UsageError(
            "command line", "known options (see drivesem --help)", _unboxed(captured.getvalue())
        ) from None
    validate(config)
    return config


def _with_presets(command: str, words: list[str]) -> list[str]:
    """Replace `--config FILE` by the file's settings, in front, so that the command line wins."""
    presets: list[str] = []
    rest: list[str] = []
    position = 0
    while position < len(words):
        word = words[position]
        if word == "--config" and position + 1 < len(words):
            presets += yaml_arguments(words[position + 1], COMMANDS[command])
            position += 2
        elif word.startswith("--config="):
            presets += yaml_arguments(word.removeprefix("--config="), COMMANDS[command])
            position += 1
        else:
            rest.append(word)
            position += 1
    return presets + rest


def _unboxed(text: str) -> str:
    """The parser's message without its frame, on one line."""
    lines = [line.strip("│╭╮╰╯─ \t") for line in text.splitlines()]
    message = " ".join(line for line in lines if line)
    message = re.split(r"For full helptext|Perhaps you meant", message)[0]
    return " ".join(message.split()) or "an unknown command"


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point. Returns the exit code: 0 done, 1 a check failed, 2 bad input, 130 interrupted."""
    try:
        config = parse(sys.argv[1:] if argv is None else argv)
        with let_go():
            return _run(config)
    except KeyboardInterrupt:
        sys.stderr.write("drivesem: interrupted; the same command goes on where it stopped\n")
        return _EXIT_INTERRUPTED
    except (ValueError, OSError) as error:
        if not _is_bad_input(error):
            raise
        sys.stderr.write(f"drivesem: {' '.join(str(error).split())}\n")
        return _EXIT_BAD_INPUT


def _is_bad_input(error: Exception) -> bool:
    """Whether an error speaks of what the user gave, not of a fault of ours."""
    if isinstance(error, UsageError | OSError):
        return True
    # Only classes of modules that are loaded can have been raised: nothing heavy is imported to find out.
    kinds = [
        kind
        for module, name in (("scene_ir.errors", "SceneError"), ("detectors.base", "DetectorError"))
        if (kind := getattr(sys.modules.get(module), name, None)) is not None
    ]
    return isinstance(error, tuple(kinds)) if kinds else False


def _run(config: Command) -> int:
    if isinstance(config, Attack):
        from drivesem import attack_command

        return attack_command.run(config)
    if isinstance(config, Transfer):
        from drivesem import transfer_command

        return transfer_command.run(config)
    if isinstance(config, Explain):
        from drivesem import explain_command

        return explain_command.run(config)
    if isinstance(config, Study):
        from drivesem import study_command

        return study_command.run(config)
    if isinstance(config, Confirm):
        from drivesem import confirm_command

        return confirm_command.run(config)
    if isinstance(config, Report):
        from drivesem import report_command

        return report_command.run(config)
    if isinstance(config, Plausibility):
        from drivesem import plausibility_command

        return plausibility_command.run(config)
    if isinstance(config, Realism):
        from drivesem import realism_command

        return realism_command.run(config)
    if isinstance(config, Worth):
        from drivesem import worth_command

        return worth_command.run(config)
    if isinstance(config, Survey):
        from drivesem import survey_command

        return survey_command.run(config)
    if isinstance(config, SurveyResults):
        from drivesem import survey_command

        return survey_command.run_results(config)
    if isinstance(config, Verify):
        from drivesem import verify_command

        return verify_command.run(config)
    if isinstance(config, Derender):
        from drivesem import derender_command

        return derender_command.run(config)
    if isinstance(config, Render):
        from drivesem import render_command

        return render_command.run(config)
    if isinstance(config, Edit):
        from drivesem import edit_command

        return edit_command.run(config)
    if isinstance(config, Synth):
        from drivesem.synth import command

        return command.run(config)
    if isinstance(config, Bench):
        from drivesem.bench import command as bench_command

        return bench_command.run(config)
    if isinstance(config, Gradcheck):
        from drivesem import gradcheck

        return gradcheck.run(config)
    if isinstance(config, Eval):
        from drivesem import eval_command

        return eval_command.run(config)
    if isinstance(config, Check):
        from drivesem import check_command

        return check_command.run(config)
    if isinstance(config, Convert):
        from drivesem import convert_command

        return convert_command.run(config)
    if isinstance(config, Train):
        from drivesem import train_command

        return train_command.run(config)
    if isinstance(config, Anchors):
        from drivesem import anchors_command

        return anchors_command.run(config)
    if isinstance(config, Retrain):
        from drivesem import retrain_command

        return retrain_command.run(config)
    raise UsageError("command", ", ".join(COMMANDS), type(config).__name__)


if __name__ == "__main__":
    sys.exit(main())
