"""Parts of OcclusionPenalty."""
