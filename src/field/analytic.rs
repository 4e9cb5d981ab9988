//! Flows in closed form.

/// A flow in closed form, with its parameters.
#[derive(Debug, Clone, PartialEq)]
pub enum Analytic {
    /// u = -pi A sin(pi f) cos(pi y), v = pi A cos(pi f) sin(pi y) df/dx, f = a x^2 + b x, a = eps sin(omega t), b = 1 - 2a
    /// (Shadden, Lekien, Marsden 2005); extruded along z.
    DoubleGyre {
        /// A.
        amplitude: f64,
        /// eps.
        epsilon: f64,
        /// omega, radians per time unit.
        omega: f64,
    },
    /// Arnold-Beltrami-Childress: u = A' sin z + C cos y, v = B sin x + A' cos z, w = C sin y + B cos x with
    /// A' = A + growth * sin(pi t) * t in the unsteady form (Haller 2001: growth 0.5).
    Abc {
        /// A.
        a: f64,
        /// B.
        b: f64,
        /// C.
        c: f64,
        /// Growth of A; 0 is the steady flow.
        growth: f64,
    },
    /// u = rate x, v = -rate y (about the origin): FTLE = rate, both ways.
    Saddle {
        /// rate.
        rate: f64,
    },
    /// Solid rotation about the origin: FTLE = 0.
    Rotation {
        /// Radians per time unit.
        omega: f64,
    },
    /// u = rate y: sigma_max^2 = 1 + g^2/2 + g sqrt(1 + g^2/4), g = rate tau.
    Shear {
        /// rate.
        rate: f64,
    },
}

impl Analytic {
    /// Axes along which the flow varies: 2 or 3.
    pub fn dimensions(&self) -> usize {
        match self {
            Analytic::Abc { .. } => 3,
            _ => 2,
        }
    }
}
