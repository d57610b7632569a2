"""The formats `fmu` and `fmu2`: co-simulation units of FMI 3.0 and 2.0 around the exported C."""
