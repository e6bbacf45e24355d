import importlib.util

import pytest
from support.built_pages import Page, build
from support.fenced import REPOSITORY


@pytest.fixture(scope="session")
def reference():
    """The module `docs/reference.py`."""
    spec = importlib.util.spec_from_file_location("reference", REPOSITORY / "docs" / "reference.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(REPOSITORY / "docs")  # as for `python docs/reference.py`
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def html(tmp_path_factory):
    """The folder of the built pages."""
    return build(tmp_path_factory.mktemp("pages"))


@pytest.fixture(scope="session")
def built(html):
    """Every built page, by its path: `tutorials/quickstart`, `reference/zoo/cartpole`."""
    files = [file for file in html.rglob("*.html") if file.name not in ("genindex.html", "search.html")]
    return {file.relative_to(html).with_suffix("").as_posix(): Page(file) for file in files}
