"""API keys for machines: made once, shown once, taken back."""

from dataclasses import asdict

from fastapi import APIRouter

from service import access_schemas as schemas
from service import deps
from service.access.records import ApiKey
from service.api import problems
from service.conditional import etag_of
from service.errors import BoundError, NameTakenError, NotFoundError

router = APIRouter(prefix="/keys", tags=["access"])


@router.get("")
def list_keys(desk: deps.Access) -> schemas.KeyList:
    """List the keys, newest first; their secrets are not kept."""
    return schemas.KeyList(items=[schemas.KeyView(**_told(key)) for key in desk.keys.all()])


@router.post("", status_code=201, name="key.create", responses=problems(BoundError, NameTakenError))
def create_key(body: schemas.KeyRequest, caller: deps.Caller, desk: deps.Access) -> schemas.MadeKeyView:
    """Make a key; the answer has its secret, which is told never again."""
    made = desk.keys.create(body.name, body.scopes, body.expires_at, by=caller.name)
    return schemas.MadeKeyView(**_told(made.key), secret=made.secret)


@router.get("/{key_id}", responses=problems(NotFoundError))
def read_key(key_id: schemas.KeyId, desk: deps.Access, fresh: deps.IfNoneMatch) -> schemas.KeyView:
    """Read a key; its secret is not kept. The ETag changes when it is taken back, not when it is used."""
    key = desk.keys.find_id(key_id)
    return fresh.told(schemas.KeyView(**_told(key)), key_etag(key))


@router.post("/{key_id}/revoke", name="key.revoke", responses=problems(NotFoundError))
def revoke_key(key_id: schemas.KeyId, caller: deps.Caller, desk: deps.Access) -> schemas.KeyView:
    """Take a key back, for good; what it has open closes within seconds."""
    return schemas.KeyView(**_told(desk.keys.revoke(key_id, by=caller.name)))


def key_etag(key: ApiKey) -> str:
    """Return the ETag of what an administrator decides about a key."""
    return etag_of("key", key.id, sorted(key.scopes), key.expires_at, key.revoked_at)


def _told(key: ApiKey) -> dict[str, object]:
    told = asdict(key) | {"scopes": sorted(key.scopes)}
    told.pop("secret_sha256")
    return told
