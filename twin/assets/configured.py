"""The settings of a database in a configuration."""

from typing import Self
from urllib.parse import urlsplit

from pydantic import field_validator, model_validator

from twin.secret import INSTEAD, Secret, refuse_password
from twin.settings import Settings


class DatabaseSettings(Settings):
    """Which database; a file beside the configuration where nothing is said."""

    url: str = ""  # or the path of an SQLite file, from the configuration's folder
    password: Secret | None = None  # password of the user in the URL, if the server requires one

    @field_validator("url")
    @classmethod
    def _has_no_password(cls, url: str) -> str:
        refuse_password(url, f"take it out, and write password = {INSTEAD}")
        return url

    @model_validator(mode="after")
    def _is_of_a_user(self) -> Self:
        if self.password is not None and not urlsplit(self.url).username:
            raise ValueError('a password needs a user: url = "postgresql://USER@HOST/NAME"')
        return self
