"""The Dockerfile, which is not built here: what it names is there."""

import re
import tomllib


def test_it_copies_what_the_package_is_built_from(repository):
    """Whatever ``.dockerignore`` keeps out is missing in the image."""
    copied = [line.split()[1:-1] for line in lines(repository / "Dockerfile", "COPY ")]
    names = {name for names in copied for name in names}
    kept = {line.removeprefix("!") for line in lines(repository / ".dockerignore", "!")}
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    assert all((repository / name).exists() for name in names) and names <= kept
    assert {"pyproject.toml", "dvo", project["readme"], *project["license-files"]} <= names


def test_torch_is_that_of_the_package(repository):
    (wanted,) = re.findall(r'"(torch[^"]*)"', (repository / "Dockerfile").read_text())
    assert wanted in tomllib.loads((repository / "pyproject.toml").read_text())["project"]["dependencies"]


def lines(file, start):
    return [line for line in file.read_text().splitlines() if line.startswith(start)]
