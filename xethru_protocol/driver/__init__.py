"""Driver of one module, blocking (`radar.X4M300`) or with asyncio (`async_radar.AsyncX4M300`)."""
