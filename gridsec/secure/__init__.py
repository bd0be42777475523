"""Secure state estimation of any linear system by the methods of the papers."""
