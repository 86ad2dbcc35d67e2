"""Livox Avia (SDK 1 protocol): wire format, decoding, session, driver."""
