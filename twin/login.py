"""How people log in, on the page and over OPC UA: one store of users, one throttle, one trail."""

from dataclasses import dataclass

from twin.audit import Act, Audit
from twin.throttle import LoginThrottle
from twin.users import Role, Users, normal

LONGEST_NAME = 100  # letters that are looked at
ADDRESS_S, NAME_S = 60.0, 10.0  # longest wait after wrong passwords, of an address and of a name


@dataclass(frozen=True)
class Login:
    """What came of a try to log in."""

    user: str
    role: Role | None  # None: refused
    wait_s: float = 0.0  # until another try is taken, after too many wrong ones


class Authenticator:
    """Lets users in; who guesses has to wait, by name and by address. One call at a time."""

    def __init__(self, users: Users, audit: Audit) -> None:
        self.users, self.audit = users, audit
        self._by_address, self._by_name = LoginThrottle(ADDRESS_S), LoginThrottle(NAME_S)

    def log_in(self, name: str, password: str, address: str) -> Login:
        """Try a password; TwinError where the users cannot be read. A hash takes its time."""
        name = normal(name.strip()[:LONGEST_NAME])
        throttles = (self._by_address, address), (self._by_name, name)
        wait_s = max(throttle.wait_s(who) for throttle, who in throttles)
        if wait_s > 0.0:
            news = [throttle.is_news(who) for throttle, who in throttles]
            if any(news):
                self.audit.record(Act.THROTTLED, name, address)
            return Login(name, None, wait_s)
        role = self.users.check(name, password)
        for throttle, who in throttles:
            (throttle.wrong if role is None else throttle.right)(who)
        self.audit.record(Act.LOGGED_IN if role else Act.WRONG_PASSWORD, name, address)
        return Login(name, role)
