"""The page over all ejectors of a broker, over HTTP; the technician's page decides on access."""

from collections.abc import Callable
from http import HTTPStatus

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from twin.assets.unit import Unit
from twin.languages.texts import tr
from twin.page.plant_overview import PlantOverview
from twin.page.plant_overview_text import counted, details, of_one, overview

ALL = "/all"


class AllEjectors:
    """The routes of that page."""

    def __init__(self, plant: PlantOverview, require_sight: Callable[[Request], None]) -> None:
        self._plant, self._require_sight = plant, require_sight

    def routes(self) -> list[Route]:
        """The routes to add to those of the technician's page."""
        return [Route("/api/all", self.all), Route("/api/all/one", self.one)]

    async def all(self, request: Request) -> Response:
        """A line for each ejector, the worst first."""
        self._require_sight(request)
        now = self._plant.clock()
        document = self._plant.look(
            lambda ejectors, failure, since: overview(ejectors, failure, since, now)
        )
        counts = {"counts": counted(document["ejectors"])}
        return JSONResponse(document | counts | {"not_understood": self._plant.not_understood})

    async def one(self, request: Request) -> Response:
        """All that is known of one ejector."""
        self._require_sight(request)
        query = request.query_params
        unit, now = Unit(query.get("type", ""), query.get("id", "")), self._plant.clock()
        document = self._plant.look(
            lambda ejectors, failure, _since: (
                details(ejector, failure, now) if (ejector := of_one(ejectors, unit)) else None
            )
        )
        if document is None:
            raise HTTPException(HTTPStatus.NOT_FOUND, tr("the broker knows no such ejector"))
        return JSONResponse(document | {"now": now})
