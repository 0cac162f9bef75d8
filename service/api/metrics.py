"""Metrics for a monitoring system; they name no patient."""

from typing import Annotated

from fastapi import APIRouter, Header, Response

from service import deps

router = APIRouter(tags=["health"])
Accept = Annotated[
    str, Header(max_length=1024, include_in_schema=False, description="OpenMetrics is written where it is accepted")
]


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {
            "description": "Prometheus's text format, or OpenMetrics where that is accepted",
            "content": {"text/plain": {}, "application/openmetrics-text": {}},
        }
    },
)
def read_metrics(services: deps.Offered, accept: Accept = "") -> Response:
    """Write counts, times and states in the text format of Prometheus."""
    text, media_type = services.metrics.text(accept)
    return Response(text, headers={"Content-Type": media_type})
