"""What Tidegate is made of, and what scanners say of it: `make sbom`, `make scan`."""
