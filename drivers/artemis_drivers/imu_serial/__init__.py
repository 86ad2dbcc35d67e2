"""IMUs on a serial port: Xsens MTi (Xbus, MTData2) and VectorNav (binary output)."""
