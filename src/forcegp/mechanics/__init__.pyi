from .gauss_principle import (
    AffineMap as AffineMap, Baumgarte as Baumgarte, ConstrainedDynamics as ConstrainedDynamics, Contact as Contact,
    State as State, fixed_frame as fixed_frame, fixed_point as fixed_point,
)
from .surfaces import (
    Held as Held, ImplicitSurface as ImplicitSurface, Plane as Plane, Sphere as Sphere,
    Surface as Surface, surface_axes as surface_axes,
)
