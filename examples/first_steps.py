import marimo

__generated_with = "0.25.2"
app = marimo.App(width="medium", app_title="turgor: first steps")


@app.cell(hide_code=True)
def _():
    import marimo as mo

    mo.md(
        """
        # First steps with turgor

        A **pressure-based soft agent** is a body of gas inside a ring of masses and springs. It moves by changing
        the lengths of its springs and the pressure of its gas. Change a slider, and whatever depends on it runs again.
        """
    )
    return (mo,)


@app.cell
def _():
    import matplotlib.pyplot as plt
    import numpy as np

    import turgor
    from turgor.view.draw import draw_frame
    from turgor.view.video import write_video

    return draw_frame, np, plt, turgor, write_video


@app.cell(hide_code=True)
def _(mo):
    mo.md("""
    ## A body, a terrain, a task
    """)
    return


@app.cell
def _(mo):
    body = mo.ui.dropdown(["small", "medium", "large"], value="small", label="body")
    name = mo.ui.dropdown(["hilly", "flat", "escape"], value="hilly", label="task")
    seed = mo.ui.slider(0, 20, value=0, label="seed of the terrain")
    mo.hstack([body, name, seed], justify="start")
    return body, name, seed


@app.cell
def _(body, name, seed, turgor):
    task = turgor.make_task(name.value, body=body.value, condition="pressure", seed=seed.value)
    simulator = turgor.Simulator(task)
    simulator
    return simulator, task


@app.cell(hide_code=True)
def _(mo):
    mo.md("""
    ## How much gas does it take to stand up?

    `replay` lets a body follow a given course of pressure, without a controller. Too little, and the ring lies flat.
    """)
    return


@app.cell
def _(mo):
    pressure = mo.ui.slider(0, 40, value=15, label="pressure [kPa]", show_value=True)
    pressure
    return (pressure,)


@app.cell
def _(draw_frame, mo, np, pressure, task, turgor):
    _steps = 300
    _rest = np.broadcast_to(task.body.rest_length, (_steps, task.body.spring_count))
    _blown = turgor.replay(
        task.body, turgor.flat(), _rest, np.full(_steps, 1e3 * pressure.value), position=turgor.resting(task.body)
    )
    mo.vstack(
        [
            mo.image(draw_frame(_blown, _steps, (800, 400)), width=640),
            mo.md(f"After 5 s its area is **{_blown.area_ratio[-1, 0]:.2f}** of the circle's, pi r^2."),
        ]
    )
    return


@app.cell(hide_code=True)
def _(mo):
    mo.md("""
    ## A hundred random controllers, then some that are evolved

    A controller is a row of numbers, theta. One call runs all of them for 30 s each.
    """)
    return


@app.cell
def _(np, simulator, task):
    theta = np.random.default_rng(0).uniform(-1, 1, (100, task.parameter_count))
    out = simulator.rollout(theta)
    out
    return (out,)


@app.cell
def _(mo):
    evaluations = mo.ui.slider(500, 10_000, step=500, value=500, label="evaluations", show_value=True)
    evaluations
    return (evaluations,)


@app.cell
def _(evaluations, task, turgor):
    run = turgor.evolve(task, evaluations=evaluations.value, seed=0)
    run
    return (run,)


@app.cell
def _(np, out, plt, run):
    _figure, (_left, _right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained", sharey=True)
    _left.plot(run.history["evaluations"], run.history["best"], label="best so far")
    _left.plot(run.history["evaluations"], run.history["median"], label="median of the generation")
    _left.set(xlabel="evaluations", ylabel="fitness [m/s]")
    _left.legend(frameon=False)
    _right.boxplot([out.fitness, run.champion.robust], tick_labels=["random", "champion, 30 moved starts"])
    _right.axhline(run.champion.fitness, color="tab:orange", linestyle=":")
    print(f"best {run.champion.fitness:.2f} m/s; median of 30 moved starts {np.median(run.champion.robust):.2f} m/s")
    _figure
    return


@app.cell(hide_code=True)
def _(mo):
    mo.md("""
    The best of many is partly the luckiest: contacts are chaotic. The box shows the champion from 30 starts that
    were moved by a millionth of a metre; the dotted line is the fitness it was chosen for.

    ## Look at it
    """)
    return


@app.cell
def _(mo, run, simulator, write_video):
    import tempfile
    from pathlib import Path

    recording = simulator.record(run.champion.theta)
    with tempfile.TemporaryDirectory() as _folder:
        _film = write_video(recording, Path(_folder) / "champion.mp4", size=(640, 360), fps=30)
        film = _film.read_bytes()
    mo.video(film, controls=True, width=640)
    return (recording,)


@app.cell(hide_code=True)
def _(mo, recording):
    mo.md(f"""
    `{recording}`

    From here: `turgor evolve --help` on the command line, `docs/environments.md` for Gymnasium, `docs/controllers.md`
    and `docs/optimizers.md` for other controllers and other optimizers.
    """)
    return


if __name__ == "__main__":
    app.run()
