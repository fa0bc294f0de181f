from robotd.sim.sensor import add_lights as add_lights
from robotd.sim.sensor import expose as expose
from robotd.sim.sensor import paint_walkers as paint_walkers
from robotd.sim.sensor import retouch as retouch
from robotd.sim.sensor import shine as shine
from robotd.sim.sensor import trace as trace
from robotd.sim.sensor import transmission as transmission
from robotd.sim.sensor import visible as visible
