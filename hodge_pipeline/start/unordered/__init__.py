"""A start from nothing: frames or scans in no order, pieces after lost tracking, several sequences of one scene."""
