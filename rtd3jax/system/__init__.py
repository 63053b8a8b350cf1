"""Files, memory, compiled programs and versions of the machine that this runs on."""
