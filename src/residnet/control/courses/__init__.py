"""Courses past buoys: what is asked for, what a vessel can follow, and the plan."""
