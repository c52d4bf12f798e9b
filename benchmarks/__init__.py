"""Measurements that the documents quote; no part of the package."""
