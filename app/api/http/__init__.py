"""Request and response handling that all resources share."""
