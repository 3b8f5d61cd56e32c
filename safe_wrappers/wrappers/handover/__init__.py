"""Parts of ChunkHandover."""
