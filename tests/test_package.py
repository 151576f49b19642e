"""The public page and the papers of the package say the same thing everywhere."""

import ast
import re
import subprocess
import tomllib
from importlib import import_module, metadata

import pytest
import yaml

import forcegp


def test_one_version_everywhere(repository):
    version = metadata.version("forcegp")
    citation = re.search(r"^version: [\"']?([^\"'\s]+)", (repository / "CITATION.cff").read_text(), re.M)
    released = re.findall(r"^## \[(\d[^\]]*)\]", (repository / "CHANGELOG.md").read_text(), re.M)
    declared = re.search(r'^version = "(.+)"$', (repository / "pyproject.toml").read_text(), re.M)
    assert declared is not None
    assert citation is not None
    assert version == declared[1], "the installation is stale: install again with `make check`"
    assert version == citation[1] == released[0] == forcegp.__version__


@pytest.mark.parametrize("name", forcegp.__all__)
def test_public_names_are_public_in_their_rooms_and_documented(name, repository):
    value, page = getattr(forcegp, name), (repository / "src/forcegp/__init__.pyi").read_text()
    (package,) = [
        node.module
        for node in ast.parse(page).body
        if isinstance(node, ast.ImportFrom) and name in {alias.asname for alias in node.names}
    ]
    assert value is getattr(import_module(f"forcegp.{package}"), name)
    assert value.__doc__, f"{name} has no docstring"
    assert name in dir(forcegp)


def test_unknown_public_name_lists_the_known_ones():
    with pytest.raises(AttributeError, match=r"no attribute 'Robbot'.*Robot"):
        forcegp.Robbot  # noqa: B018


def test_every_error_says_what_it_means():
    from forcegp import errors

    classes = [value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, Exception)]
    for error in classes:
        assert error.__doc__, f"{error.__name__} has no docstring"
        assert issubclass(error, errors.ForceGPError | Warning), f"{error.__name__} is outside the tree of errors"


def test_the_installed_package_carries_its_types_and_its_command():
    files = import_module("importlib.resources").files("forcegp")
    assert (files / "py.typed").is_file()
    assert (files / "data/__init__.pyi").is_file()  # read at run time, too
    commands = metadata.entry_points(group="console_scripts", name="forcegp")
    assert [command.value for command in commands] == ["forcegp.cli.main:main"]


def project(repository):
    return tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_source_distribution_holds_all_that_the_tests_read(repository):
    if not (repository / ".git").exists():
        pytest.skip("an unpacked source distribution has no git")
    listed = subprocess.run(["git", "ls-files"], cwd=repository, capture_output=True, text=True, check=True).stdout
    tracked = {name.partition("/")[0] for name in listed.splitlines()}
    listed = project(repository)["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    included = {name.removeprefix("/") for name in listed}
    assert included == tracked - {".gitignore", "pyproject.toml"}  # which hatch adds by itself


def test_the_published_page_has_no_link_that_only_the_repository_can_follow(repository):
    text = (repository / "README.md").read_text(encoding="utf-8")
    relative = re.findall(r"\]\((?!https?:)([^)#]+)\)", text)
    for rule in project(repository)["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(rule["pattern"], rule["replacement"], text)
    targets = re.findall(r"(!?)\[[^\]]*\]\(([^)]+)\)", text)
    assert len(relative) > 10
    assert set(relative) <= {target.partition("/v$HFPR_VERSION/")[2] for _, target in targets}
    for picture, target in targets:
        if not picture or "/forcegp/forcegp/" not in target:
            assert target.startswith("https://"), target
            continue
        assert target.startswith("https://raw.githubusercontent.com/forcegp/forcegp/v$HFPR_VERSION/docs/"), target


def test_one_address_everywhere(repository):
    urls = project(repository)["project"]["urls"]
    home = urls["Homepage"]
    assert all(url.startswith(home) for url in urls.values())
    assert f"repository-code: {home}\n" in (repository / "CITATION.cff").read_text()
    version = project(repository)["project"]["version"]
    assert f"[{version}]: {home}/compare/" in (repository / "CHANGELOG.md").read_text()


def test_every_python_that_is_promised_is_tested_and_classified(repository):
    table = project(repository)["project"]
    classified = re.findall(r"Python :: (3\.\d+)'", str(table["classifiers"]))
    jobs = workflow(repository, "checks")["jobs"]
    (matrix,) = (job["strategy"]["matrix"] for job in jobs.values() if "strategy" in job)
    assert matrix["python"] == classified
    assert table["requires-python"] == f">={classified[0]}"
    assert {model.partition("-")[0] for model in matrix["system"]} == {"ubuntu", "macos"}


def workflow(repository, name):
    return yaml.safe_load((repository / ".github" / "workflows" / f"{name}.yml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["checks", "nightly", "release"])
def test_workflows_run_what_there_is(repository, name):
    """Every step either uses an action of one commit, or runs; every target of make exists."""
    content = workflow(repository, name)
    assert set(content) >= {"name", True, "permissions", "jobs"}  # YAML 1.1 reads the key `on` as True
    assert content["permissions"] == {"contents": "read"}
    targets = set(re.findall(r"^([a-z-]+):", (repository / "Makefile").read_text(), re.M))
    for job in content["jobs"].values():
        assert job["timeout-minutes"] <= 360
        for step in job["steps"]:
            assert ("uses" in step) != ("run" in step)
            assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", step.get("uses", "a/b@" + "0" * 40))
            assert set(re.findall(r"^make ([a-z-]+)", step.get("run", ""), re.M)) <= targets


def test_releases_are_published_without_a_secret_and_only_from_tags(repository):
    content = workflow(repository, "release")
    assert content[True] == {"push": {"tags": ["v*"]}}
    publish = content["jobs"]["publish"]
    assert publish["permissions"] == {"id-token": "write"}
    assert publish["needs"] == ["check", "wheel", "try"]
    installs = [step["run"] for step in content["jobs"]["wheel"]["steps"] if "install" in step.get("run", "")]
    options = "--require-hashes --only-binary :all: -r .github/release-requirements.txt"
    assert installs == [f"python -m pip install {options}"]
    pinned = (repository / ".github" / "release-requirements.txt").read_text()
    assert len(re.findall(r"^[\w-]+==", pinned, re.M)) <= pinned.count("--hash=sha256:")
    made = project(repository)["build-system"]["requires"]
    assert all(re.search(rf"^{re.split('[<>=]', each)[0]}==", pinned, re.M) for each in made)
    assert "secrets." not in (repository / ".github/workflows/release.yml").read_text()


def test_other_files_of_the_repository_parse_and_agree(repository):
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)", (repository / "constraints.txt").read_text(), re.M))
    hooks = yaml.safe_load((repository / ".pre-commit-config.yaml").read_text())
    (ruff,) = (entry for entry in hooks["repos"] if entry["repo"].endswith("/ruff-pre-commit"))
    assert ruff["rev"] == f"v{pins['ruff']}"
    for form in (repository / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        content = yaml.safe_load(form.read_text())
        if form.name != "config.yml":
            assert set(content) >= {"name", "description", "body"}
            assert all({"type", "attributes"} <= set(field) for field in content["body"])


def test_the_conda_recipe_needs_what_the_wheel_needs(repository):
    recipe = yaml.safe_load((repository / ".github/conda-forge/recipe.yaml").read_text())
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    there = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
    parts = (re.fullmatch(r"([\w-]+)(.*)", each) for each in project["dependencies"])
    pins = dict(part.groups() for part in parts if part)
    needed = {f"{there.get(name, name).lower()} {pin}".strip() for name, pin in pins.items()}
    assert set(recipe["requirements"]["run"][1:]) == needed
    assert recipe["context"]["version"] == project["version"]


def test_no_picture_is_there_twice(repository):
    pictures = {path.relative_to(repository) for path in (repository / "docs").rglob("*.svg")}
    assert not {path for path in pictures if (repository / path).with_suffix(".png").exists()}


def test_every_module_of_a_public_name_is_checked_strictly(repository):
    text = (repository / "pyright-public.json").read_text()
    checked = set(re.findall(r'"(src/forcegp/[^"]+)"', text))
    public = {getattr(forcegp, name).__module__ for name in forcegp.__all__}
    assert checked >= {f"src/{module.replace('.', '/')}.py" for module in public}
    assert '"typeCheckingMode": "strict"' in text
