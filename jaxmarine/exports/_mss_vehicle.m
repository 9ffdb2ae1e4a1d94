function [xdot, U, M] = VEHICLE(x, ui, Vc, betaVc, w_c)
% [xdot, U, M] = VEHICLE(x, ui, Vc, betaVc, w_c) returns the time derivative of the state vector
%
%   x = [ u v w p q r x y z phi theta psi THRUSTS ]'
%
% in m, rad, m/s, rad/s and N, the speed U (m/s) and the 6x6 mass matrix M; THRUSTS are thrusts of thrusters
% that follow with a lag.
%
%   ui:             commands, -1 to 1, in the order COMMANDS
%   Vc, betaVc:     speed (m/s) and direction (rad) of an ocean current, optional
%   w_c:            its velocity down (m/s), optional
%
% The current of the model itself is added to it. No other function is needed.

PARAMETERS
slow = p.lag > 0;

if nargin == 0, x = zeros(12 + sum(slow), 1); ui = zeros(length(p.lag), 1); end
if nargin < 4, Vc = 0; betaVc = 0; end
if nargin < 5, w_c = 0; end
if length(x) ~= 12 + sum(slow), error('x-vector must have dimension %d!', 12 + sum(slow)); end
if length(ui) ~= length(p.lag), error('u-vector must have dimension %d!', length(p.lag)); end
x = x(:); ui = ui(:);

% Thrusts that the commands ask for (N): dead zone, saturation, curve
c = sign(ui) .* max(abs(ui) - p.deadband, 0);
c = max(min(c, p.saturation), -p.saturation);
most = p.max_thrust .* (ui >= 0) + p.max_thrust_reverse .* (ui < 0);
asked = most .* ((1 - p.quadratic_share) .* c + p.quadratic_share .* c .* abs(c));
acting = asked;
acting(slow) = x(13:end);

nu = x(1:6); phi = x(10); theta = x(11); psi = x(12);
R = [cos(psi) -sin(psi) 0; sin(psi) cos(psi) 0; 0 0 1] ...
    * [cos(theta) 0 sin(theta); 0 1 0; -sin(theta) 0 cos(theta)] ...
    * [1 0 0; 0 cos(phi) -sin(phi); 0 sin(phi) cos(phi)];

% Velocity through the water; a locked axis feels none
flow = R' * (p.current + [Vc * cos(betaVc); Vc * sin(betaVc); w_c]);
nu_r = p.free .* (nu - [flow; 0; 0; 0]);
Dnu_c = p.free .* [cross(flow, nu(4:6)); 0; 0; 0];

down = R(3,:)';
g = -[(p.weight - p.buoyancy) * down; cross(p.weight_moment - p.buoyancy_moment, down)];
tau = p.allocation * acting + p.wrench;
sum_tau = tau - C_nu(p.rigid, nu) - C_nu(p.added, nu_r) + p.added * Dnu_c ...
    - p.linear * nu_r - p.quadratic * (abs(nu_r) .* nu_r) - g;

% Locked axes do not accelerate
M = p.rigid + p.added;
both = p.free * p.free';
nu_dot = (both .* M + diag(1 - p.free)) \ (p.free .* sum_tau);

T = [1 sin(phi)*tan(theta) cos(phi)*tan(theta); 0 cos(phi) -sin(phi); ...
    0 sin(phi)/cos(theta) cos(phi)/cos(theta)];
xdot = [nu_dot; R * nu(1:3); T * nu(4:6); (asked(slow) - acting(slow)) ./ p.lag(slow)];
U = norm(nu(1:3));

end

function f = C_nu(M, nu)
% C(nu) nu of a symmetric mass matrix
a = M * nu;
f = [cross(nu(4:6), a(1:3)); cross(nu(1:3), a(1:3)) + cross(nu(4:6), a(4:6))];
end
