"""The rig that is walked with: its devices' settings and its calibration, as files of ``firmware_cfg/``."""
