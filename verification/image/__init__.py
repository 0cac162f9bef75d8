"""The image, built and run: `make docker-test`. Needs root, buildah, iproute2 and util-linux; no container engine."""
