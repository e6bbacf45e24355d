"""Release checks: public names, licences, versions, contents of the archives."""

import importlib.metadata
import importlib.util
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from support.fenced import REPOSITORY
from support.source_copies import copy_sources
from test_dependencies import pinned

import rlcli

FREE = re.compile(r"MIT|BSD|Apache|ISC|PSF|Python Software Foundation|CC0|Mozilla|MPL")
COPYLEFT = re.compile(r"GPL|EUPL|CeCILL|Commons Clause|Proprietary", re.IGNORECASE)
ONLY_TESTED_WITH = {"psycopg", "psycopg-binary"}


def script(name):
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(REPOSITORY / "docs")  # as for `python docs/NAME.py`
        spec.loader.exec_module(module)
    return module


def licence_of(distribution):
    """Return the licence in the metadata of a package."""
    metadata = importlib.metadata.metadata(distribution)
    classified = [line.rpartition("::")[2] for line in metadata.get_all("Classifier") or [] if "License ::" in line]
    return metadata.get("License-Expression") or " ".join(classified) or metadata.get("License") or ""


def test_public_words_are_up_to_date():
    reference = script("reference")
    known, now = set(reference.WORDS.read_text().splitlines()), set(reference.public_words())
    assert not known - now, "user files may contain it: note it in the changelog, then `python docs/reference.py`"
    assert not now - known, "`python docs/reference.py` notes what is new"


def test_removed_public_name_is_detected(monkeypatch):
    import rlcli.errors
    from rlcli.cli import app

    reference = script("reference")
    names, words = reference.public_names("rlcli.errors"), set(reference.public_words())
    monkeypatch.delattr(rlcli.errors, "listing")
    entries = [entry for entry in reference.term_entries() if entry.name != "is_alive"]
    monkeypatch.setattr(reference, "term_entries", lambda: entries)
    assert set(names) - set(reference.public_names("rlcli.errors")) == {"listing"}
    assert words - set(reference.public_words()) == {"term rewards.is_alive"}
    assert {f"command rlcli {name}" for name in app.COMMANDS} <= words
    assert {"option rlcli train --seeds", "key sb3.ppo.learning_rate", "key Task.episode_length_s"} <= words


def test_licences_page_is_up_to_date():
    licences = script("licences")
    assert licences.PAGE.read_text(encoding="utf-8") == licences.page(), "python docs/licences.py writes it anew"
    named = {canonicalize_name(Requirement(line).name) for _, line in licences.requirements()}
    assert set(licences.LICENCES) == named, "a licence of what is not needed any more"


def test_licences_match_package_metadata():
    licences = script("licences")
    checked = 0
    for name, (licence, _) in licences.LICENCES.items():
        try:
            said = licence_of(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # not all trackers are installed
        family = re.match(r"MIT|BSD|Apache|PSF|MPL|LGPL|ISC", licence)[0]
        family = {"PSF": "PSF|Python Software", "MPL": "MPL|Mozilla"}.get(family, family)
        assert re.search(family, said), f"{name}: {said}"
        checked += 1
    assert checked > 35


def test_no_dependency_has_copyleft_licence():
    checked = 0
    for name in pinned().keys() - ONLY_TESTED_WITH:
        try:
            said = licence_of(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        assert FREE.search(said), f"{name}: {said[:200]}"
        assert not COPYLEFT.search(said) or "BSD" in said, f"{name}: {said[:200]}"
        checked += 1
    assert checked > 100


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """The source archive, the wheel built from it, and a wheel built from another folder."""
    folder = tmp_path_factory.mktemp("archives")
    copy_sources(REPOSITORY, folder / "one" / "rlcli")
    shutil.copytree(folder / "one" / "rlcli", folder / "another" / "rlcli")
    for place in ("one", "another"):
        for junk in ("runs/cartpole/x/run.json", "rlcli/__pycache__/a.pyc", "docs/_build/x.html", "junk.txt"):
            file = folder / place / "rlcli" / junk
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("junk")
        command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / f"{place}-out")]
        done = subprocess.run([*command, str(folder / place / "rlcli")], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    return {place: folder / f"{place}-out" for place in ("one", "another")}


def single_file(folder, pattern):
    (file,) = folder.glob(pattern)
    return file


@pytest.mark.slow
def test_source_archive_contents(archives):
    with tarfile.open(single_file(archives["one"], "*.tar.gz")) as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    tracked = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True)
    if tracked.returncode == 0:
        strangers = names - set(tracked.stdout.splitlines()) - {"PKG-INFO"}
        assert not strangers, "not of the repository"
    needed = ["LICENSE", "README.md", "CHANGELOG.md", "pyproject.toml", "constraints.txt", "Makefile", "rlcli/py.typed"]
    needed += ["docs/index.md", "docs/conf.py", "tests/conftest.py", "tasks/rlcli_tasks/index.json"]
    assert set(needed) <= names
    assert not [name for name in names if re.search(r"__pycache__|\.pyc$|^runs/|_build/|\.egg-info|junk\.txt", name)]


@pytest.mark.slow
def test_wheel_is_reproducible_without_paths(archives):
    one, another = (single_file(archives[place], "*.whl") for place in ("one", "another"))
    with zipfile.ZipFile(one) as left, zipfile.ZipFile(another) as right:
        assert left.namelist() == right.namelist()
        places = [str(archives["one"].parent).encode(), str(REPOSITORY).encode(), b"/root/", b"/home/"]
        for name in left.namelist():
            content = left.read(name)
            assert content == right.read(name), name
            assert not [place for place in places if place in content], name
    assert one.read_bytes() == another.read_bytes()


@pytest.mark.slow
def test_wheel_metadata(archives):
    with zipfile.ZipFile(single_file(archives["one"], "*.whl")) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        metadata = Parser().parsestr(archive.read(name).decode())
        assert [n for n in archive.namelist() if n.endswith("licenses/LICENSE")]
        assert {"rlcli/py.typed", "rlcli_tasks/py.typed"} <= set(archive.namelist())
    assert metadata["Version"] == rlcli.__version__
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["Description-Content-Type"] == "text/markdown"
    description = metadata.get_payload()
    assert "rlcli train cartpole" in description
    assert re.findall(r"\]\((?!https?:)[^)]+\)", description) == [], "links that a package index cannot resolve"
    for minor in (11, 12, 13):
        assert f"Programming Language :: Python :: 3.{minor}" in metadata.get_all("Classifier")


def test_changelog_and_package_versions_agree():
    changelog = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changelog, re.MULTILINE)[1] == rlcli.__version__
    release = tuple(map(int, rlcli.__version__.split(".")[:2]))
    for file in REPOSITORY.glob("plugins/*/pyproject.toml"):
        wanted = re.search(r'"rlcli>=([\d.]+)"', file.read_text(encoding="utf-8"))[1]
        assert tuple(map(int, wanted.split(".")[:2])) <= release, file
