"""Metrics for a monitoring system; they name no patient."""

from fastapi import APIRouter, Response

from service import deps

router = APIRouter(tags=["health"])
MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "Prometheus's text format", "content": {"text/plain": {}}}},
)
def read_metrics(services: deps.Offered) -> Response:
    """Write counts, times and states in the text format of Prometheus."""
    return Response(services.metrics.text(), media_type=MEDIA_TYPE)
