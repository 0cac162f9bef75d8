"""HTTP and the page: API, live stream, middleware, connections, dashboard, container."""
