"""Route of the metrics; they contain no patient data."""

from typing import Annotated

from fastapi import APIRouter, Header, Response

from service.web import dependencies

router = APIRouter(tags=["health"])
Accept = Annotated[
    str,
    Header(max_length=1024, include_in_schema=False, description="OpenMetrics is returned if the client accepts it"),
]


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {
            "description": "Prometheus text format, or OpenMetrics if accepted",
            "content": {"text/plain": {}, "application/openmetrics-text": {}},
        }
    },
)
def read_metrics(services: dependencies.AppServices, accept: Accept = "") -> Response:
    """Return counters, times and states in Prometheus text format or OpenMetrics."""
    text, media_type = services.metrics.text(accept)
    return Response(text, headers={"Content-Type": media_type})
