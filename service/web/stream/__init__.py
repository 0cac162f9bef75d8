"""The live stream: one hub encodes each message once and distributes it to all clients."""
