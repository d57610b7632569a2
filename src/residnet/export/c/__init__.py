"""The format `c`: one C99 source file and its header, without any runtime."""
