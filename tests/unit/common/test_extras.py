"""The command that a missing extra names: it works although there is no release on PyPI."""

import json
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from services.common import extras
from services.common.errors import InputError
from services.common.extras import check_installed, install_command


class Installed:
    """In the place of pip's record of an installation."""

    def __init__(self, url: str | None) -> None:
        self._url = url

    def read_text(self, name: str) -> str | None:
        assert name == "direct_url.json"
        return None if self._url is None else json.dumps({"url": self._url})


def installed_from(monkeypatch: pytest.MonkeyPatch, url: str | None) -> None:
    monkeypatch.setattr(extras, "distribution", lambda name: Installed(url))


def test_wheel_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    wheel = tmp_path / "a folder" / "driveby-0.1.0-py3-none-any.whl"
    wheel.parent.mkdir()
    wheel.touch()
    installed_from(monkeypatch, wheel.as_uri())
    assert install_command("identify,view") == f'pip install "{wheel}[identify,view]"'
    with pytest.raises(
        InputError, match=r"^x needs none_such, which is not installed: pip install"
    ):
        check_installed("x", "none_such", extra="view")


def test_checkout_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    installed_from(monkeypatch, tmp_path.as_uri())
    assert install_command("view") == f'pip install -e "{tmp_path}[view]"'


@pytest.mark.parametrize("url", [None, "file:///none/driveby.whl", "https://host/driveby.whl"])
def test_unknown_origin_is_the_wheel_of_the_user(
    monkeypatch: pytest.MonkeyPatch, url: str | None
) -> None:
    installed_from(monkeypatch, url)
    assert install_command("view") == 'pip install "WHEEL[view]" with your wheel of driveby'


def test_no_installation_is_the_wheel_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(extras, "distribution", missing)
    assert install_command("view").startswith('pip install "WHEEL[view]"')
