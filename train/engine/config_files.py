"""Check of the YAML files on a command line before LightningCLI, whose loader has no bounds, reads them."""

from __future__ import annotations

from pathlib import Path

from dvo.core.yaml_files import read_yaml

SUFFIXES = (".yaml", ".yml")


def check_files(arguments: list[str]) -> None:
    """Check every YAML file that a command line names, as the configuration or as the value of another option.

    Args:
        arguments: of the command line, without the name of the program.

    Raises:
        DvoError: a file that is not valid YAML within the bounds of :mod:`dvo.core.yaml_files`.
    """
    before = ""
    for argument in arguments:
        name, separator, value = argument.partition("=")
        text, option = (value, name) if separator and name.startswith("-") else (argument, before)
        path, before = Path(text), argument
        if (option in ("--config", "-c") or path.suffix in SUFFIXES) and len(text) < 4096 and path.exists():
            read_yaml(path)  # refuses pipes and devices, which the parser would wait for
