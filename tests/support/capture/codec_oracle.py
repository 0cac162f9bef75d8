"""``16zT`` read pixel by pixel, as its description says: the oracle for the fast one."""


def decode_slowly(payload: bytes, pixels: int) -> list[int] | None:
    """Return the depths, or None where the bytes are no picture of so many pixels."""
    try:
        ranks = int.from_bytes(payload[:2], "little")
        table = [int.from_bytes(payload[2 + 2 * i : 4 + 2 * i], "little") for i in range(ranks)]
        at = 2 + 2 * ranks
        if len(payload) < at + 2:
            return None
        walked = _walk(payload, at)
        return [table[rank] for rank in walked] if len(walked) == pixels else None
    except IndexError:
        return None


def count_pixels(stream: bytes) -> int:
    """Return how many pixels these codes stand for; at least one, also where they end within a step."""
    try:
        return len(_walk(bytes(2) + stream, 0))
    except IndexError:
        return 1


def _walk(payload: bytes, at: int) -> list[int]:
    rank = int.from_bytes(payload[at : at + 2], "little")
    ranks, at = [rank], at + 2

    def step(size: int) -> None:
        nonlocal rank
        rank = (rank - size) & 0xFFFF
        ranks.append(rank)

    while at < len(payload):
        code, at = payload[at], at + 1
        if 0xE0 <= code < 0xFF:
            ranks.extend([rank] * (2 * (code - 0xE0)))
            continue
        if code < 0xE0:
            step((code >> 4) - 6)
            if code & 15 not in {13, 15}:
                step((code & 15) - 6)
        if code == 0xFF or code & 15 == 15:
            if payload[at] >= 0x80:
                step(payload[at] - 192)
            else:
                rank = payload[at] << 8 | payload[at + 1]
                ranks.append(rank)
                at += 1
            at += 1
    return ranks
