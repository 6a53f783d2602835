"""`python -m endo_sim_ros.cli`, the same as `endo-sim`."""

from endo_sim_ros.cli import main

raise SystemExit(main())
