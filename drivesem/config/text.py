"""Settings as text: the config.yaml of a run, a command line."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Collection

import yaml

from drivesem.config.blocks import CommandConfig, Options, option


def command_line(command: str, config: CommandConfig, presentation: Collection[str] = ()) -> str:
    """The command line that gives this configuration, without the settings named in `presentation`."""
    words = ["drivesem", command]
    for setting in dataclasses.fields(config):
        value = getattr(config, setting.name)
        if value == setting.default or setting.name in presentation:
            continue
        if isinstance(value, bool):
            words.append(option(setting.name if value else f"no-{setting.name}"))
        else:
            words += [option(setting.name), str(value)]
    return shlex.join(words)


def to_yaml(config: Options) -> str:
    """The resolved configuration, as it is written beside the results."""
    return yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)
