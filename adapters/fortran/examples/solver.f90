!> A small solver that publishes: decaying Taylor-Green vortices in a mean flow, an exact solution of the Navier-Stokes
!> equations on a periodic box.
!>
!>     gfortran solver.f90 -I PREFIX/include -L PREFIX/lib -lridgewatch_fortran -lridgewatch_adapter -o solver
!>     RIDGEWATCH_RING=/dev/shm/ridgewatch-$(id -u)/demo ./solver 200
!>
!> Arguments: steps (100), nodes along each axis (64), milliseconds per step (20).
program solver
  use, intrinsic :: iso_fortran_env, only: real64, error_unit
  use, intrinsic :: iso_c_binding, only: c_int
  use ridgewatch
  implicit none
  interface
    function usleep(microseconds) bind(c)
      import :: c_int
      integer(c_int), value :: microseconds
      integer(c_int) :: usleep
    end function
  end interface
  real(real64), parameter :: box = 6.283185307179586d0, dt = 0.05d0, viscosity = 0.01d0
  type(rw_publisher) :: publisher
  ! With ghost cells, as solvers have them. Publishing a section makes no copy of it.
  real(real64), allocatable :: u(:, :), v(:, :)
  real(real64) :: t, x, y, decay
  integer :: steps, n, pause, step, i, j, status, ignored

  steps = argument(1, 100)
  n = argument(2, 64)
  pause = argument(3, 20)
  if (steps < 1 .or. n < 4 .or. n > 4096) stop 2
  call publisher%begin(2)
  call publisher%uniform(1, 0d0, box * (n - 1) / n, n, period=box)
  call publisher%uniform(2, 0d0, box * (n - 1) / n, n, period=box)
  call publisher%open(status)
  if (status > rw_off) write (error_unit, *) "solver: not published: ", rw_message()
  if (status == rw_off) write (error_unit, *) "solver: RIDGEWATCH_RING is not set: nothing is published"

  allocate (u(0:n + 1, 0:n + 1), v(0:n + 1, 0:n + 1))
  do step = 0, steps - 1
    t = step * dt
    decay = exp(-2 * viscosity * t)
    do j = 0, n + 1
      do i = 0, n + 1
        x = box * (i - 1) / n - 0.5d0 * t
        y = box * (j - 1) / n
        u(i, j) = 0.5d0 + decay * sin(x) * cos(y) + 0.2d0 * sin(2 * y + t)
        v(i, j) = -decay * cos(x) * sin(y)
      end do
    end do
    call publisher%publish(step, t, u(1:n, 1:n), v(1:n, 1:n), status)
    if (status > rw_off) write (error_unit, *) "solver: step ", step, ": ", rw_message()
    ignored = usleep(int(1000 * pause, c_int))
  end do
  call publisher%close()
  print "(i0, a)", steps, " steps"

contains

  integer function argument(at, otherwise)
    integer, intent(in) :: at, otherwise
    character(32) :: text
    integer :: failed
    argument = otherwise
    call get_command_argument(at, text)
    if (len_trim(text) == 0) return
    read (text, *, iostat=failed) argument
    if (failed /= 0) stop 2
  end function
end program
