!> Makes each kind of call once, with values that fortran_module.rs checks: u = i + 10 j + 100 k, v = 2 u, w = 3 u.
program test
  use, intrinsic :: iso_fortran_env, only: real32, real64, int64
  use ridgewatch
  implicit none
  type(rw_publisher) :: publisher, second
  real(real32) :: u32(4, 3, 2), v32(4, 3, 2), w32(4, 3, 2)
  real(real64) :: u64(0:5, 8, 2), v64(0:5, 8, 2), w64(0:5, 8, 2), plane(4, 3)
  real(real32) :: east(4, 3), west(4, 3)
  character(:), allocatable :: message
  character(200) :: ring
  integer :: i, j, k, status, unit
  integer(int64) :: published, overwrote, before, after, rate

  call publisher%begin(3)
  call publisher%uniform(1, 0d0, 3d0, 4)
  call publisher%rectilinear(2, [0d0, 1d0, 4d0])
  call publisher%uniform(3, 0d0, 1d0, 2, period=5d0)
  call publisher%slots(8)
  call publisher%start(20261122_int64)
  call publisher%open(status)
  call want(status == rw_ok, 1)
  do k = 1, 2
    do j = 1, 3
      do i = 1, 4
        u32(i, j, k) = i + 10 * j + 100 * k
        ! Every second row, with ghost cells.
        u64(i, 2 * j, k) = u32(i, j, k)
      end do
    end do
  end do
  v32 = 2 * u32
  w32 = 3 * u32
  v64 = 2 * u64
  w64 = 3 * u64
  call publisher%publish(1, 0.5d0, u32, v32, w32, status)
  call want(status == rw_ok, 2)
  call publisher%publish(2_int64, 1.5d0, u64(1:4, 2:6:2, :), v64(1:4, 2:6:2, :), w64(1:4, 2:6:2, :), status)
  call want(status == rw_ok, 3)
  ! Wrong shapes, a wrong rank and different strides are refused, and nothing is read.
  call publisher%publish(3, 2d0, u32(1:3, :, :), v32(1:3, :, :), w32(1:3, :, :), status)
  call want(status == rw_argument, 4)
  call says("`u` has 3 x 3 x 2 nodes; accepted: 4 x 3 x 2, as the ring was opened", 40)
  call publisher%publish(3, 2d0, u32, v32, w32(:, 2:, :), status)
  call want(status == rw_argument, 41)
  call says("`w` has 4 x 2 x 2 nodes; accepted: 4 x 3 x 2, as the ring was opened", 42)
  plane = 0
  call publisher%publish(3, 2d0, plane, plane, status)
  call want(status == rw_argument, 5)
  call says("components have 2 dimensions; accepted: 3", 43)
  call publisher%publish(3, 2d0, u64(1:4, 2:6:2, :), v64(1:4, 1:3, :), w64(1:4, 1:3, :), status)
  call want(status == rw_argument, 6)
  call says("`v` has strides 1, 6, 48; accepted: 1, 12, 48, as `u`", 44)
  call publisher%publish(3, 2d0, u64(4:1:-1, 2:6:2, :), v64(1:4, 2:6:2, :), w64(4:1:-1, 2:6:2, :), status)
  call want(status == rw_argument, 45)
  call says("`v` has strides 1, 12, 48; accepted: -1, 12, 48, as `u`", 46)
  ! A new description applies to the next opening: smaller arrays are still refused.
  call publisher%uniform(1, 0d0, 2d0, 3)
  call publisher%publish(3, 2d0, u32(1:3, :, :), v32(1:3, :, :), w32(1:3, :, :), status)
  call want(status == rw_argument, 90)
  call publisher%block(0, 1, [1, 1, 1], [3, 3, 2])
  call publisher%publish(3, 2d0, u32(1:3, :, :), v32(1:3, :, :), w32(1:3, :, :), status)
  call want(status == rw_argument, 91)
  ! A grid of five dimensions is refused, and later calls read and write nothing of it.
  call second%begin(5, status)
  call want(status == rw_argument, 35)
  call says("`dimensions` is 5; accepted: 2 or 3", 47)
  call second%block(0, 1, [1, 1, 1, 1, 1], [2, 2, 2, 2, 2], status)
  call want(status == rw_argument, 36)
  call says("`description` is null; accepted: a result of rw_describe", 48)
  call second%begin(2)
  call second%uniform(3, 0d0, 1d0, 4, status=status)
  call want(status == rw_argument, 49)
  call says("`axis` is 3; accepted: 1 to 2", 50)
  call second%rectilinear(-2, [0d0, 1d0], status=status)
  call want(status == rw_argument, 51)
  call says("`axis` is -2; accepted: 1 to 2", 52)
  call second%block(0, 1, [1, 1], [2], status)
  call want(status == rw_argument, 53)
  call says("`first` and `extent` have 2 and 1 numbers; accepted: 2, one per dimension", 54)
  call second%uniform(1, 0d0, 1d0, 4)
  call second%uniform(2, 0d0, 1d0, 4)
  call second%open(status)
  message = rw_message()
  call want(status == rw_in_use .and. index(message, "another producer") > 0, 7)
  call second%publish(0, 0d0, plane, plane, status)
  call want(status == rw_off, 8)
  call says("", 55)
  call second%close()
  call publisher%close(status)
  call want(status == rw_ok, 9)
  ! Longitude and latitude, in a separate ring whose folder is named.
  call get_environment_variable("RIDGEWATCH_RING", ring)
  call publisher%begin(2)
  call publisher%sphere(6.371d6)
  call publisher%uniform(1, 0d0, 270d0, 4, period=360d0)
  call publisher%rectilinear(2, [-60d0, 0d0, 60d0])
  call publisher%open(status, trim(ring) // "/globe")
  call want(status == rw_ok, 10)
  ! Opening again ends the first ring and frees its name.
  call publisher%open(status, trim(ring) // "/globe")
  call want(status == rw_ok, 34)
  east = reshape([(real(i, real32), i=1, 12)], [4, 3])
  call publisher%publish(7000000000_int64, 2d0, east, east + 12, status)
  call want(status == rw_ok, 11)
  call publisher%close(status)
  call want(status == rw_ok, 12)
  ! Two blocks of one grid, beside each other, in hours.
  call publisher%begin(2)
  call second%begin(2)
  call half(publisher, 0)
  call half(second, 1)
  call publisher%statistics(published, overwrote, status)
  call want(status == rw_off .and. published == 0 .and. overwrote == 0, 13)
  call publisher%open(status, trim(ring) // "/blocks")
  call want(status == rw_ok, 14)
  call second%open(status, trim(ring) // "/blocks")
  call want(status == rw_ok, 15)
  west = -east
  call publisher%publish(1, 1d0, east(1:2, :), west(1:2, :), status)
  call want(status == rw_ok, 16)
  call second%publish(1, 1d0, east(3:4, :), west(3:4, :), status)
  call want(status == rw_ok, 17)
  ! Two steps fit. The third waits for a follower to come; the fourth does not, because that wait timed out.
  call publisher%publish(2, 2d0, east(1:2, :), east(1:2, :), status)
  call system_clock(before, rate)
  call publisher%publish(3, 3d0, east(1:2, :), east(1:2, :), status)
  call system_clock(after)
  call want(status == rw_ok .and. after - before >= rate / 5, 18)
  call publisher%publish(4, 4d0, east(1:2, :), east(1:2, :), status)
  call system_clock(before)
  call want(status == rw_ok .and. before - after < rate / 5, 19)
  call publisher%statistics(published, overwrote, status)
  call want(status == rw_ok .and. published == 4 .and. overwrote == 2, 20)
  call second%statistics(published, overwrote)
  call want(published == 1 .and. overwrote == 0, 21)
  call publisher%close(status)
  call want(status == rw_ok, 22)
  call second%close(status)
  call want(status == rw_ok, 23)
  ! A ring that was removed by hand.
  call publisher%begin(2)
  call publisher%uniform(1, 0d0, 3d0, 4)
  call publisher%uniform(2, 0d0, 2d0, 3)
  call publisher%open(status, trim(ring) // "/removed")
  call want(status == rw_ok, 24)
  call publisher%publish(1, 1d0, east, east, status)
  call want(status == rw_ok, 25)
  open(newunit=unit, file=trim(ring) // "/removed/block-00000.ring", status="old")
  close(unit, status="delete")
  call publisher%publish(2, 2d0, east, east, status)
  message = rw_message()
  call want(status == rw_removed .and. index(message, "was removed") > 0, 26)
  call publisher%close(status)
  call want(status == rw_ok, 27)

contains

  !> Compares the text of the last error.
  subroutine says(expected, line)
    character(*), intent(in) :: expected
    integer, intent(in) :: line
    character(:), allocatable :: found
    found = rw_message()
    call want(found == expected .and. len(found) == len(expected), line)
  end subroutine

  subroutine half(of, index)
    type(rw_publisher), intent(inout) :: of
    integer, intent(in) :: index
    integer :: found
    call of%uniform(1, 0d0, 3d0, 4)
    call of%uniform(2, 0d0, 2d0, 3)
    call of%block(index, 2, [1 + 2 * index, 1], [2, 3], found)
    call want(found == rw_ok, 30)
    call of%time_unit("h ", found)
    call want(found == rw_ok, 31)
    call of%slots(2, found)
    call want(found == rw_ok, 32)
    call of%wait(200, found)
    call want(found == rw_ok, 33)
  end subroutine

  subroutine want(holds, line)
    logical, intent(in) :: holds
    integer, intent(in) :: line
    if (holds) return
    print *, "check ", line, " failed: ", rw_message()
    error stop 1
  end subroutine
end program
