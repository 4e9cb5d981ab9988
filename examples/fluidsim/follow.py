"""fluidsim, followed live: 2-D turbulence or the 3-D Taylor-Green vortex.

    pip install fluidsim fluidfft pyfftw WHEEL_OF_RIDGEWATCH_ADAPTER
    RIDGEWATCH_RING=/dev/shm/ridgewatch-$(id -u)/fluidsim python follow.py 2d
    ridgewatch attach examples/fluidsim/live.toml /dev/shm/ridgewatch-$(id -u)/fluidsim

Only the lines between the marks are ours: a solver publishes by calling one function after each step. A ring that cannot be had is a warning, and the
simulation goes on without.
"""

import argparse
import importlib
import time

import numpy as np

from ridgewatch_adapter import Publisher


def parameters(kind, nodes, end):
    solver = importlib.import_module("fluidsim.solvers.ns2d.solver" if kind == "2d" else "fluidsim.solvers.ns3d.solver")
    params = solver.Simul.create_default_params()
    oper, box = params.oper, 2 * np.pi
    oper.nx = oper.ny = nodes
    oper.Lx = oper.Ly = box
    if kind == "3d":
        oper.nz, oper.Lz = nodes, box
        oper.type_fft = "fft3d.with_pyfftw"
        params.init_fields.type = "in_script"
        params.nu_2 = 1 / 400
    else:
        oper.type_fft = "fft2d.with_pyfftw"
        params.init_fields.type = "noise"
        params.init_fields.noise.velo_max = 1.0
        params.init_fields.noise.length = 1.0
        params.nu_8 = 1e-12 * (256 / nodes) ** 8
    params.time_stepping.USE_CFL = False
    params.time_stepping.deltat0 = 0.01 if kind == "2d" else 0.02
    params.time_stepping.USE_T_END = True
    params.time_stepping.t_end = end
    params.output.HAS_TO_SAVE = False
    return solver.Simul, params


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=["2d", "3d"])
    parser.add_argument("--nodes", type=int, default=128)
    parser.add_argument("--end", type=float, default=10.0, help="simulated time")
    parser.add_argument("--every", type=int, default=5, help="publish every so many steps")
    parser.add_argument("--pause", type=float, default=0.0, help="seconds to wait after each published step, for the pace of a larger simulation")
    options = parser.parse_args()
    Simul, params = parameters(options.kind, options.nodes, options.end)
    sim = Simul(params)
    if options.kind == "3d":
        z, y, x = sim.oper.get_XYZ_loc()[::-1]
        sim.state.init_statephys_from(
            vx=np.sin(x) * np.cos(y) * np.cos(z), vy=-np.cos(x) * np.sin(y) * np.cos(z), vz=np.zeros_like(x)
        )
        sim.state.statespect_from_statephys()
        sim.state.statephys_from_statespect()
        sim.output.init_with_initialized_state()

    # --- ridgewatch: the grid, once
    box, nodes = 2 * np.pi, options.nodes
    axis = np.arange(nodes) * box / nodes
    axes = [axis] * (2 if options.kind == "2d" else 3)
    names = ["ux", "uy"] if options.kind == "2d" else ["vx", "vy", "vz"]
    with Publisher(*axes, periods=[box] * len(axes)) as publisher:
        # --- and after each step one call
        stepping, count = sim.time_stepping, 0
        while stepping.t < options.end:
            if count % options.every == 0:
                publisher.publish(stepping.it, stepping.t, *(sim.state.get_var(name) for name in names))
                time.sleep(options.pause)
            stepping.one_time_step()
            count += 1
        print(f"{count} steps, {publisher.published} published, {publisher.overwrote} before an older one was taken")


if __name__ == "__main__":
    main()
