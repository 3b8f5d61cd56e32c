"""The report's pictures: one per module, each with a sentence that reads it for the case at hand."""
