from robotd.sim.sensor import (
    add_lights as add_lights,
    expose as expose,
    paint_walkers as paint_walkers,
    retouch as retouch,
    shine as shine,
    trace as trace,
    transmission as transmission,
    visible as visible,
)
