"""Routes of API keys for machines."""

from dataclasses import asdict

from fastapi import APIRouter

from service.access.accounts import schemas
from service.access.accounts.records import ApiKey
from service.core.conditional import etag_of
from service.web import dependencies

router = APIRouter(prefix="/keys", tags=["access"])


@router.get("")
def list_keys(desk: dependencies.Access) -> schemas.KeyList:
    """List the keys, newest first; secrets are not stored."""
    return schemas.KeyList(items=[schemas.KeyView(**_public(key)) for key in desk.keys.all()])


@router.post("", status_code=201, name="key.create")
def create_key(body: schemas.KeyRequest, caller: dependencies.Caller, desk: dependencies.Access) -> schemas.MadeKeyView:
    """Create a key; only this answer contains its secret."""
    made = desk.keys.create(body.name, body.scopes, body.expires_at, by=caller.name)
    return schemas.MadeKeyView(**_public(made.key), secret=made.secret)


@router.get("/{key_id}")
def read_key(key_id: schemas.KeyId, desk: dependencies.Access, fresh: dependencies.IfNoneMatch) -> schemas.KeyView:
    """Read a key, without its secret. The ETag changes when the key is revoked, not when it is used."""
    key = desk.keys.find_id(key_id)
    return fresh.answer(schemas.KeyView(**_public(key)), key_etag(key))


@router.post("/{key_id}/revoke", name="key.revoke")
def revoke_key(key_id: schemas.KeyId, caller: dependencies.Caller, desk: dependencies.Access) -> schemas.KeyView:
    """Revoke a key permanently; its open streams close within seconds."""
    return schemas.KeyView(**_public(desk.keys.revoke(key_id, by=caller.name)))


def key_etag(key: ApiKey) -> str:
    """Return the ETag of the fields that an administrator can change."""
    return etag_of("key", key.id, sorted(key.scopes), key.expires_at, key.revoked_at)


def _public(key: ApiKey) -> dict[str, object]:
    fields = asdict(key) | {"scopes": sorted(key.scopes)}
    fields.pop("secret_sha256")
    return fields
