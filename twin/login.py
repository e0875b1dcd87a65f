"""Login on the page and over OPC UA: one store of users, one throttle, one audit trail."""

from dataclasses import dataclass

from twin.audit import Act, Audit
from twin.throttle import FILE, LoginThrottle
from twin.users import Role, Users, normal

LONGEST_NAME = 100  # letters of a name that count
ADDRESS_S, NAME_S = 60.0, 10.0  # longest wait after wrong passwords, of an address and of a name


@dataclass(frozen=True)
class Login:
    """The result of an attempt to log in."""

    user: str
    role: Role | None  # None: refused
    wait_s: float = 0.0  # until the next attempt is accepted, after too many wrong ones


class Authenticator:
    """Checks passwords and slows down guessing, by name and by address. One call at a time.

    Attempts are counted in a file beside the users, for all processes.
    """

    def __init__(self, users: Users, audit: Audit) -> None:
        self.users, self.audit = users, audit
        longest_s = {"address": ADDRESS_S, "name": NAME_S}
        self._throttle = LoginThrottle(users.path.with_name(FILE), longest_s)

    def log_in(self, name: str, password: str, address: str) -> Login:
        """Try a password; TwinError if the users cannot be read. Hashing takes time."""
        name = normal(name.strip()[:LONGEST_NAME])
        who = {"address": address, "name": name}
        wait = self._throttle.take(who)
        if wait.seconds > 0.0:
            if wait.is_news:
                self.audit.record(Act.THROTTLED, name, address)
            return Login(name, None, wait.seconds)
        role = self.users.check(name, password)
        if role is not None:
            self._throttle.right(who)
        self.audit.record(Act.LOGGED_IN if role else Act.WRONG_PASSWORD, name, address)
        return Login(name, role)
