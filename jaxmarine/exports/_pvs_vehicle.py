import numpy as np

PARAMETERS = {}


class vehicle:
    """
    vehicle()                    Step commands
    vehicle('stepInput',r,V_c,beta_c,tau_X)

    The arguments are those that PythonVehicleSimulator hands to every vehicle: V_c is the current's speed
    (m/s), beta_c its direction (deg); the current of the model is added. The others are not used.

    [nu, u_actual] = dynamics(eta,nu,u_actual,u_control,sampleTime) integrates the equations of motion by
    Euler's method. u_control holds the thrusters' commands, -1 to 1, u_actual their thrusts (N).
    """

    def __init__(self, controlSystem="stepInput", r=0, V_current=0, beta_current=0, tau_X=0):
        p = {key: np.array(value, float) for key, value in PARAMETERS["numbers"].items()}
        self.name = PARAMETERS["name"]
        self.controls = [f"{one} command (-)" for one in PARAMETERS["thrusters"]]
        self.dimU = len(self.controls)
        self.controlMode = "stepInput"
        self.controlDescription = "Step inputs"
        self.ref = r
        self.V_c = V_current
        self.beta_c = np.deg2rad(beta_current)
        self.nu = np.zeros(6)
        self.u_actual = np.zeros(self.dimU)

        self.MRB, self.MA = p["rigid"], p["added"]
        self.D, self.Dn = p["linear"], p["quadratic"]
        self.tau_0 = p["wrench"]
        self.v_c = p["current"]
        self.W, self.B = p["weight"], p["buoyancy"]
        self.rW, self.rB = p["weight_moment"], p["buoyancy_moment"]
        self.T = p["allocation"]
        self.thruster = p
        # Locked axes do not accelerate
        free = p["free"]
        both = np.outer(free, free)
        self.Minv = both * np.linalg.inv(both * (self.MRB + self.MA) + np.diag(1 - free))
        self.free = free

    def thrust(self, u):
        """Thrusts (N) that commands ask for: dead zone, saturation, curve."""
        p = self.thruster
        most = np.where(u < 0, p["max_thrust_reverse"], p["max_thrust"])
        c = np.where(np.abs(u) <= p["deadband"], 0, u - np.sign(u) * p["deadband"])
        c = np.clip(c, -p["saturation"], p["saturation"])
        share = p["quadratic_share"]
        return most * ((1 - share) * c + share * c * np.abs(c))

    def dynamics(self, eta, nu, u_actual, u_control, sampleTime):
        p = self.thruster
        asked = self.thrust(np.asarray(u_control, float))
        slow = p["lag"] > 0
        acting = np.where(slow, u_actual, asked)

        R = rotation(eta[3], eta[4], eta[5])
        current = self.v_c + self.V_c * np.array([np.cos(self.beta_c), np.sin(self.beta_c), 0])
        flow = R.T @ current
        nu_r = (nu - np.append(flow, [0, 0, 0])) * self.free
        Dnu_c = np.append(np.cross(flow, nu[3:]), [0, 0, 0])

        down = R[2]
        g = -np.append((self.W - self.B) * down, np.cross(self.rW - self.rB, down))
        sum_tau = (
            self.T @ acting
            + self.tau_0
            - coriolis(self.MRB, nu)
            - coriolis(self.MA, nu_r)
            + self.MA @ (Dnu_c * self.free)
            - self.D @ nu_r
            - self.Dn @ (np.abs(nu_r) * nu_r)
            - g
        )
        nu_dot = self.Minv @ sum_tau

        # Forward Euler integration [k+1]
        nu = nu + sampleTime * nu_dot
        change = (asked - acting) / np.where(slow, p["lag"], 1)
        u_actual = np.where(slow, acting + sampleTime * change, asked)
        return nu, u_actual

    def stepInput(self, t):
        """Half ahead."""
        return np.full(self.dimU, 0.5)


def rotation(phi, theta, psi):
    """From BODY to NED."""
    cphi, sphi, cth, sth, cpsi, spsi = (f(a) for a in (phi, theta, psi) for f in (np.cos, np.sin))
    return np.array(
        [
            [cpsi * cth, -spsi * cphi + cpsi * sth * sphi, spsi * sphi + cpsi * cphi * sth],
            [spsi * cth, cpsi * cphi + sphi * sth * spsi, -cpsi * sphi + sth * spsi * cphi],
            [-sth, cth * sphi, cth * cphi],
        ]
    )


def coriolis(M, nu):
    """C(nu) nu of a symmetric mass matrix."""
    a, b = (M @ nu)[:3], (M @ nu)[3:]
    return np.append(np.cross(nu[3:], a), np.cross(nu[:3], a) + np.cross(nu[3:], b))
