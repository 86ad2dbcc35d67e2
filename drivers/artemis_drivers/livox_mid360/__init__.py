"""Livox Mid-360 (SDK 2 protocol): wire format, decoding, session, driver."""
