"""Recording directories of the vendor's ModuleConnector."""
