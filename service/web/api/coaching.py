"""Routes of coaching: what a session's patient screen shows, and the pairing of screens."""

from fastapi import APIRouter, Response

from service.access.login.cookies import set_screen_cookie
from service.access.service import AccessService
from service.core.schemas import coaching
from service.core.schemas.base import Identifier
from service.web import dependencies

router = APIRouter(tags=["coaching"])


@router.post("/coach/code", status_code=201, name="screen.code")
def open_pairing_code(caller: dependencies.Caller, desk: dependencies.Access) -> coaching.PairingCodeView:
    """Open a code for one patient screen; it replaces a code that is still open."""
    opened = desk.screens.open_code(by=caller.name)
    left_s = (opened.expires_at - desk.store.now()).total_seconds()
    return coaching.PairingCodeView(code=opened.code, expires_at=opened.expires_at, expires_in_s=round(left_s, 1))


@router.post("/coach/pair", status_code=204, name="screen.pair")
def pair_screen(
    body: coaching.PairRequest, desk: dependencies.Access, address: dependencies.Address, response: Response
) -> None:
    """Pair this browser as a patient screen: set its cookie, which permits watching the coaching stream alone."""
    paired = desk.screens.pair(body.code, address)
    set_screen_cookie(response, paired.token, desk.cookies)


@router.get("/coach/screens")
def list_screens(desk: dependencies.Access) -> coaching.ScreenList:
    """List the paired screens."""
    return _screens(desk)


@router.post("/coach/screens/{screen_id}/end", name="screen.end")
def end_screen(screen_id: Identifier, caller: dependencies.Caller, desk: dependencies.Access) -> coaching.ScreenList:
    """End a pairing; the screen's stream closes within two seconds. Returns the screens that are left."""
    desk.screens.end(screen_id, by=caller.name)
    return _screens(desk)


@router.get("/coach/me")
def read_watcher(caller: dependencies.Caller) -> coaching.WatcherView:
    """Return who watches: whether this browser is a paired screen."""
    is_screen = caller.identity.kind == "screen"
    return coaching.WatcherView(is_screen=is_screen, expires_at=caller.identity.until if is_screen else None)


@router.get("/sessions/{session_id}/coaching")
def read_coaching(session_id: dependencies.SessionId, services: dependencies.AppServices) -> coaching.CoachingView:
    """Return what the patient screen shows of the running session."""
    return _view(services.coaching.settings(session_id))


@router.put(
    "/sessions/{session_id}/coaching",
    name="coaching.set",
)
def set_coaching(
    session_id: dependencies.SessionId,
    body: coaching.CoachingRequest,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
) -> coaching.CoachingView:
    """Set what the patient screen shows of the running session; what is left out gets its default.

    Practice is refused while the gate is armed. Nothing here reaches the gate.
    """
    operator = caller.checked_actor(body.operator)
    return _view(services.coaching.set(session_id, body.coaching, operator=operator))


def _view(settings: coaching.Coaching) -> coaching.CoachingView:
    return coaching.CoachingView(**{name: getattr(settings, name) for name in coaching.CoachingView.model_fields})


def _screens(desk: AccessService) -> coaching.ScreenList:
    return coaching.ScreenList(
        items=[
            coaching.ScreenView(
                id=screen.id,
                number=screen.number,
                paired_by=screen.paired_by,
                address=screen.address,
                paired_at=screen.paired_at,
                seen_at=seen_at,
                expires_at=screen.expires_at,
            )
            for screen, seen_at in desk.screens.all()
        ],
        code_expires_at=desk.screens.code_expiry(),
    )
