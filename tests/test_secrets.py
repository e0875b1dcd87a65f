"""Secrets stand in files and environment variables: in no configuration, log, page or message."""

from pathlib import Path
from typing import Any

import pytest

from drivers.opcua.settings import User
from drivers.outputs.settings import ResultsSettings
from drivers.plc.settings import OpcuaServer
from twin.alarms.database_url import place_of
from twin.alarms.settings import AlarmSettings
from twin.assets.database_url import AssetsSettings, chosen
from twin.assets.engine import ASSETS, Database, parse_url, shown
from twin.errors import ConfigError
from twin.figures.settings import FigureSettings
from twin.notifications.settings import (
    EmailSettings,
    MqttSettings,
    OutletsSettings,
    WebhookSettings,
)
from twin.notifications.webhook import Webhook
from twin.secret import Secret
from twin.settings import Document, Settings

SECRET = "s3cretS3cretS3cretS3cret"
POSTGRES = "postgresql://twin@db.plant/twin"
BASIC = {"policies": ["Basic256Sha256"], "certificates": "pki"}


def refused(table: dict[str, Any], kind: type[Settings]) -> str:
    with pytest.raises(ConfigError) as caught:
        Document("cell.toml", "", {"table": table}).section(kind, "table")
    said = f"{caught.value} {caught.value.hint}"
    assert SECRET not in said
    return said


@pytest.mark.parametrize("kind", [AlarmSettings, AssetsSettings, FigureSettings])
@pytest.mark.parametrize(
    "url",
    [
        f"postgresql://twin:{SECRET}@db.plant/twin",
        f"postgresql://twin@db.plant/twin?password={SECRET}",
        f"postgresql://twin@db.plant/twin?sslPassword={SECRET}",
    ],
)
def test_no_password_in_the_url_of_a_database(kind: type[Settings], url: str) -> None:
    assert "password = { file =" in refused({"url": url}, kind)


@pytest.mark.parametrize(
    ("table", "kind"),
    [
        ({"url": POSTGRES, "password": SECRET}, AlarmSettings),
        ({"host": "broker", "user": "ann", "password": SECRET}, MqttSettings),
        ({"url": "https://a", "headers": {"A": SECRET}}, WebhookSettings),
        (
            {"host": "mail", "sender": "a@b.example", "user": "ann", "password": SECRET},
            EmailSettings,
        ),
        ({"name": "ann", "password": SECRET}, User),
    ],
)
def test_no_secret_itself(table: dict[str, Any], kind: type[Settings]) -> None:
    assert '{ file = "FILE" } or { env = "NAME" }' in refused(table, kind)


@pytest.mark.parametrize("kind", [ResultsSettings, OpcuaServer])
def test_no_password_of_a_user(kind: type[Settings]) -> None:
    table = {**BASIC, "users": {"ann": SECRET}}
    assert "the name of a file is needed; twin users makes it" in refused(table, kind)


@pytest.mark.parametrize(
    "url",
    [
        f"https://hooks.plant/services/T1/{SECRET}",
        f"https://desk.plant/alarms?token={SECRET}",
        f"https://desk.plant/alarms#{SECRET}",
        f"https://ann:{SECRET}@desk.plant/alarms",
        f"https://{SECRET}@desk.plant/alarms",
    ],
)
def test_no_token_in_the_address_of_a_service(url: str) -> None:
    assert "url = { file =" in refused({"url": url}, WebhookSettings)
    assert "url = { file =" in refused({"upload": {"logs": "a", "url": url}}, OutletsSettings)


def test_a_whole_address_may_be_a_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = WebhookSettings(url=Secret(env="HOOK"))
    monkeypatch.setenv("HOOK", f"https://hooks.plant/services/{SECRET}")
    hook = Webhook(wanted, Path(), pytest.fail)
    assert hook._url.endswith(SECRET)
    assert SECRET not in hook._where
    hook.close()
    monkeypatch.setenv("HOOK", SECRET)
    with pytest.raises(ConfigError, match=r"\[webhook\] url is no address") as caught:
        Webhook(wanted, Path(), pytest.fail)
    assert SECRET not in str(caught.value)


def test_an_unknown_key_shows_no_value() -> None:
    assert "token: unknown key" in refused({"token": SECRET}, WebhookSettings)


def test_a_password_goes_to_the_database_and_is_not_shown(tmp_path: Path) -> None:
    (tmp_path / "pw").write_text(f"{SECRET}\n")
    (tmp_path / "pw").chmod(0o600)
    table = {"url": POSTGRES, "password": {"file": "pw"}}
    document = Document(str(tmp_path / "cell.toml"), "", {"assets": table, "alarms": table})
    for url in (chosen("", document), place_of(document)):
        assert url.password == SECRET
        assert SECRET not in f"{url} {shown(url)}"
    database = Database(chosen("", document), ASSETS, 0.1, lambda: 0)
    assert SECRET not in database.name
    database.close()


def test_a_password_needs_a_user() -> None:
    assert "needs a user" in refused({"password": {"env": "PW"}}, AlarmSettings)


def test_no_password_in_a_url_on_the_command_line() -> None:
    with pytest.raises(ConfigError, match="PGPASSWORD") as caught:
        parse_url(f"postgresql://twin:{SECRET}@db.plant/twin", ASSETS)
    assert SECRET not in str(caught.value)
