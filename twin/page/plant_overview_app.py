"""The page over all ejectors of a broker, over HTTP; who may see it, the technician's page says."""

from collections.abc import Callable
from http import HTTPStatus

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from twin.assets.unit import Unit
from twin.language import tr
from twin.page.plant_overview import PlantOverview
from twin.page.plant_overview_text import counted, details, of_one, overview

ALL = "/all"


class AllEjectors:
    """What there is of it to ask for."""

    def __init__(self, hall: PlantOverview, require_sight: Callable[[Request], None]) -> None:
        self._hall, self._require_sight = hall, require_sight

    def routes(self) -> list[Route]:
        """Beside those of the technician's page."""
        return [Route("/api/all", self.all), Route("/api/all/one", self.one)]

    async def all(self, request: Request) -> Response:
        """A line for each, the worst first."""
        self._require_sight(request)
        now = self._hall.clock()
        told = self._hall.look(lambda heard, trouble, since: overview(heard, trouble, since, now))
        counts = {"counts": counted(told["ejectors"])}
        return JSONResponse(told | counts | {"not_understood": self._hall.not_understood})

    async def one(self, request: Request) -> Response:
        """All that is known of one."""
        self._require_sight(request)
        asked = request.query_params
        unit, now = Unit(asked.get("type", ""), asked.get("id", "")), self._hall.clock()
        told = self._hall.look(
            lambda heard, trouble, _since: (
                details(found, trouble, now) if (found := of_one(heard, unit)) else None
            )
        )
        if told is None:
            raise HTTPException(HTTPStatus.NOT_FOUND, tr("the broker knows no such ejector"))
        return JSONResponse(told | {"now": now})
