!> Publishes a Fortran solver's velocity to ridgewatch. The module calls the C library, whose header ridgewatch.h documents each call.
!>
!>     use ridgewatch
!>     type(rw_publisher) :: publisher
!>     call publisher%begin(2)                             ! dimensions
!>     call publisher%uniform(1, 0d0, 1d0, nx)             ! axis, first node, last node, nodes (and: period)
!>     call publisher%uniform(2, 0d0, 1d0, ny)
!>     call publisher%open(status)                         ! in the folder RIDGEWATCH_RING; rw_off if it is not set
!>     call publisher%publish(step, time, u, v, status)    ! step: int32 or int64; u(nx, ny): real32 or real64, any section of an array
!>     call publisher%close()
!>
!> Errors never stop the solver: a call without `status` ignores them, and rw_message() returns the text of the last one.
module ridgewatch
  use, intrinsic :: iso_c_binding
  use, intrinsic :: iso_fortran_env, only: real32, real64, int32, int64
  implicit none
  private
  public :: rw_publisher, rw_message, rw_ok, rw_off, rw_argument, rw_in_use, rw_no_space, rw_foreign, rw_system, &
            rw_forked, rw_internal, rw_removed

  integer, parameter :: rw_ok = 0, rw_off = 1, rw_argument = 2, rw_in_use = 3, rw_no_space = 4, rw_foreign = 5, rw_system = 6, &
                        rw_forked = 7, rw_internal = 8, rw_removed = 9

  character(3), parameter :: names = "uvw"

  !> Text of an error of this module, of fixed length: publishing allocates nothing, not even for errors.
  type :: words
    character(kind=c_char, len=300) :: text
    integer :: length = 0
  end type

  !> One component of a step: the address of its first value, and its layout in elements.
  type :: component
    type(c_ptr) :: first = c_null_ptr
    integer :: dimensions = 0, bytes = 4
    integer(int64) :: extent(3) = 1, strides(3) = 1
  end type

  !> A grid while it is described, then an open ring.
  type :: rw_publisher
    private
    integer :: dimensions = 0
    type(c_ptr) :: description = c_null_ptr, field = c_null_ptr
    ! Nodes of the described axes, of the described block (0: the whole grid), and of the open ring.
    integer(c_int64_t) :: nodes(3) = 1, block_nodes(3) = 0, extent(3) = 1
  contains
    procedure :: begin => publisher_begin
    procedure :: uniform => publisher_uniform
    procedure :: rectilinear => publisher_rectilinear
    procedure :: sphere => publisher_sphere
    procedure :: block => publisher_block
    procedure :: start => publisher_start
    procedure :: time_unit => publisher_time_unit
    procedure :: slots => publisher_slots
    procedure :: wait => publisher_wait
    procedure :: open => publisher_open
    procedure :: statistics => publisher_statistics
    procedure :: close => publisher_close
    procedure, private :: publish_2_real32_int32, publish_2_real64_int32, publish_3_real32_int32, publish_3_real64_int32
    procedure, private :: publish_2_real32_int64, publish_2_real64_int64, publish_3_real32_int64, publish_3_real64_int64
    generic :: publish => publish_2_real32_int32, publish_2_real64_int32, publish_3_real32_int32, publish_3_real64_int32, &
      publish_2_real32_int64, publish_2_real64_int64, publish_3_real32_int64, publish_3_real64_int64
  end type

  interface
    function c_describe(dimensions) bind(c, name="rw_describe")
      import
      integer(c_int32_t), value :: dimensions
      type(c_ptr) :: c_describe
    end function
    subroutine c_free(description) bind(c, name="rw_free_description")
      import
      type(c_ptr), value :: description
    end subroutine
    function c_uniform(description, axis, first, last, nodes, period) bind(c, name="rw_describe_uniform")
      import
      type(c_ptr), value :: description
      integer(c_int32_t), value :: axis
      real(c_double), value :: first, last, period
      integer(c_int64_t), value :: nodes
      integer(c_int) :: c_uniform
    end function
    function c_rectilinear(description, axis, coordinates, nodes, period) bind(c, name="rw_describe_rectilinear")
      import
      type(c_ptr), value :: description
      integer(c_int32_t), value :: axis
      real(c_double), intent(in) :: coordinates(*)
      integer(c_int64_t), value :: nodes
      real(c_double), value :: period
      integer(c_int) :: c_rectilinear
    end function
    function c_sphere(description, radius) bind(c, name="rw_describe_sphere")
      import
      type(c_ptr), value :: description
      real(c_double), value :: radius
      integer(c_int) :: c_sphere
    end function
    function c_block(description, index, count, offset, extent) bind(c, name="rw_describe_block")
      import
      type(c_ptr), value :: description
      integer(c_int32_t), value :: index, count
      integer(c_int64_t), intent(in) :: offset(*), extent(*)
      integer(c_int) :: c_block
    end function
    function c_start(description, start) bind(c, name="rw_describe_start")
      import
      type(c_ptr), value :: description
      integer(c_int64_t), value :: start
      integer(c_int) :: c_start
    end function
    function c_time_unit(description, unit) bind(c, name="rw_describe_time_unit")
      import
      type(c_ptr), value :: description
      character(kind=c_char), intent(in) :: unit(*)
      integer(c_int) :: c_time_unit
    end function
    function c_statistics(field, published, overwrote) bind(c, name="rw_statistics")
      import
      type(c_ptr), value :: field
      integer(c_int64_t), intent(inout) :: published, overwrote
      integer(c_int) :: c_statistics
    end function
    function c_slots(description, slots) bind(c, name="rw_describe_slots")
      import
      type(c_ptr), value :: description
      integer(c_int32_t), value :: slots
      integer(c_int) :: c_slots
    end function
    function c_wait(description, milliseconds) bind(c, name="rw_describe_wait")
      import
      type(c_ptr), value :: description
      integer(c_int32_t), value :: milliseconds
      integer(c_int) :: c_wait
    end function
    function c_open(ring, description, field) bind(c, name="rw_open")
      import
      type(c_ptr), value :: ring, description
      type(c_ptr), intent(out) :: field
      integer(c_int) :: c_open
    end function
    function c_strided_f32(field, step, time, u, v, w, strides) bind(c, name="rw_publish_strided_f32")
      import
      type(c_ptr), value :: field, u, v, w
      integer(c_int64_t), value :: step
      real(c_double), value :: time
      integer(c_int64_t), intent(in) :: strides(*)
      integer(c_int) :: c_strided_f32
    end function
    function c_strided_f64(field, step, time, u, v, w, strides) bind(c, name="rw_publish_strided_f64")
      import
      type(c_ptr), value :: field, u, v, w
      integer(c_int64_t), value :: step
      real(c_double), value :: time
      integer(c_int64_t), intent(in) :: strides(*)
      integer(c_int) :: c_strided_f64
    end function
    function c_close(field) bind(c, name="rw_close")
      import
      type(c_ptr), value :: field
      integer(c_int) :: c_close
    end function
    function c_error() bind(c, name="rw_error")
      import
      type(c_ptr) :: c_error
    end function
    subroutine c_set_error(text) bind(c, name="rw_set_error")
      import
      character(kind=c_char), intent(in) :: text(*)
    end subroutine
    function c_strlen(text) bind(c, name="strlen")
      import
      type(c_ptr), value :: text
      integer(c_size_t) :: c_strlen
    end function
  end interface

contains

  !> Text of the last error of this thread; empty if there is no memory for it.
  function rw_message() result(message)
    character(:), allocatable :: message
    character(c_char), pointer :: letters(:)
    type(c_ptr) :: text
    integer :: i, failed
    text = c_error()
    call c_f_pointer(text, letters, [c_strlen(text)])
    allocate (character(size(letters)) :: message, stat=failed)
    if (failed /= 0) then
      allocate (character(0) :: message, stat=failed)
      return
    end if
    do i = 1, size(letters)
      message(i:i) = letters(i)
    end do
  end function

  subroutine give(found, status)
    integer, intent(in) :: found
    integer, intent(out), optional :: status
    if (present(status)) status = found
  end subroutine

  subroutine add(self, piece)
    type(words), intent(inout) :: self
    character(*), intent(in) :: piece
    integer :: fits
    fits = min(len(piece), len(self%text) - 1 - self%length)
    self%text(self%length + 1:self%length + fits) = piece(:fits)
    self%length = self%length + fits
  end subroutine

  subroutine add_number(self, number)
    type(words), intent(inout) :: self
    integer(int64), intent(in) :: number
    character(20) :: digits
    integer(int64) :: rest
    integer :: first
    ! The remainder keeps the number's sign, because the most negative number has no positive counterpart.
    rest = number
    first = len(digits) + 1
    do
      first = first - 1
      digits(first:first) = achar(iachar("0") + int(abs(mod(rest, 10_int64))))
      rest = rest / 10
      if (rest == 0) exit
    end do
    if (number < 0) call add(self, "-")
    call add(self, digits(first:))
  end subroutine

  !> Adds numbers with a separator.
  subroutine add_numbers(self, numbers, between)
    type(words), intent(inout) :: self
    integer(int64), intent(in) :: numbers(:)
    character(*), intent(in) :: between
    integer :: k
    do k = 1, size(numbers)
      if (k > 1) call add(self, between)
      call add_number(self, numbers(k))
    end do
  end subroutine

  !> Refuses a call before it reaches the library. rw_message() returns the text, as for the library's errors.
  subroutine refuse(found, why, status)
    integer, intent(in) :: found
    type(words), intent(inout) :: why
    integer, intent(out), optional :: status
    why%text(why%length + 1:why%length + 1) = c_null_char
    call c_set_error(why%text)
    call give(found, status)
  end subroutine

  !> Refuses a call because an allocation failed.
  subroutine refuse_memory(bytes, status)
    integer(int64), intent(in) :: bytes
    integer, intent(out), optional :: status
    type(words) :: why
    call add(why, "no memory for ")
    call add_number(why, bytes)
    call add(why, " bytes")
    call refuse(rw_system, why, status)
  end subroutine

  !> Returns true if the described grid has the axis. Without a description the library refuses the call.
  function has_axis(self, axis, status)
    class(rw_publisher), intent(in) :: self
    integer, intent(in) :: axis
    integer, intent(out), optional :: status
    logical :: has_axis
    type(words) :: why
    has_axis = .not. c_associated(self%description) .or. (axis >= 1 .and. axis <= self%dimensions)
    if (has_axis) return
    call add(why, "`axis` is ")
    call add_number(why, int(axis, int64))
    call add(why, "; accepted: 1 to ")
    call add_number(why, int(self%dimensions, int64))
    call refuse(rw_argument, why, status)
  end function

  !> Begins the description of a grid of 2 or 3 dimensions. Closes an open ring.
  subroutine publisher_begin(self, dimensions, status)
    class(rw_publisher), intent(inout) :: self
    integer, intent(in) :: dimensions
    integer, intent(out), optional :: status
    integer :: found
    call publisher_close(self, found)
    if (c_associated(self%field)) then
      call give(found, status)
      return
    end if
    self%description = c_describe(int(dimensions, c_int32_t))
    self%nodes = 1
    self%block_nodes = 0
    self%dimensions = merge(dimensions, 0, c_associated(self%description))
    call give(merge(rw_ok, rw_argument, c_associated(self%description)), status)
  end subroutine

  !> Describes axis 1, 2 or 3 of the global grid with evenly spaced nodes. period: period of the axis, if it has one.
  subroutine publisher_uniform(self, axis, first, last, nodes, period, status)
    class(rw_publisher), intent(inout) :: self
    integer, intent(in) :: axis, nodes
    real(real64), intent(in) :: first, last
    real(real64), intent(in), optional :: period
    integer, intent(out), optional :: status
    real(real64) :: repeats
    integer :: found
    if (.not. has_axis(self, axis, status)) return
    repeats = 0
    if (present(period)) repeats = period
    found = c_uniform(self%description, int(axis - 1, c_int32_t), first, last, int(nodes, c_int64_t), repeats)
    if (found == rw_ok) self%nodes(axis) = nodes
    call give(found, status)
  end subroutine

  !> Describes axis 1, 2 or 3 of the global grid by its coordinates, strictly ascending.
  subroutine publisher_rectilinear(self, axis, coordinates, period, status)
    class(rw_publisher), intent(inout) :: self
    integer, intent(in) :: axis
    real(real64), intent(in) :: coordinates(:)
    real(real64), intent(in), optional :: period
    integer, intent(out), optional :: status
    real(real64) :: repeats
    real(real64), allocatable :: packed(:)
    integer :: failed, found
    if (.not. has_axis(self, axis, status)) return
    repeats = 0
    if (present(period)) repeats = period
    allocate (packed(size(coordinates)), stat=failed)
    if (failed /= 0) then
      call refuse_memory(8 * size(coordinates, kind=int64), status)
      return
    end if
    packed(:) = coordinates
    found = c_rectilinear(self%description, int(axis - 1, c_int32_t), packed, size(packed, kind=c_int64_t), repeats)
    if (found == rw_ok) self%nodes(axis) = size(packed)
    call give(found, status)
  end subroutine

  !> Makes axes 1 and 2 longitude and latitude in degrees.
  subroutine publisher_sphere(self, radius, status)
    class(rw_publisher), intent(inout) :: self
    real(real64), intent(in) :: radius
    integer, intent(out), optional :: status
    call give(c_sphere(self%description, radius), status)
  end subroutine

  !> Describes this process's block: nodes first .. first + extent - 1 (from 1) along each axis; index (from 0) of count blocks.
  subroutine publisher_block(self, index, count, first, extent, status)
    class(rw_publisher), intent(inout) :: self
    integer, intent(in) :: index, count, first(:), extent(:)
    integer, intent(out), optional :: status
    integer(c_int64_t) :: offset(3), nodes(3)
    integer :: found
    type(words) :: why
    if (size(first) < self%dimensions .or. size(extent) < self%dimensions) then
      call add(why, "`first` and `extent` have ")
      call add_numbers(why, int([size(first), size(extent)], int64), " and ")
      call add(why, " numbers; accepted: ")
      call add_number(why, int(self%dimensions, int64))
      call add(why, ", one per dimension")
      call refuse(rw_argument, why, status)
      return
    end if
    offset = 0
    nodes = 1
    offset(:self%dimensions) = first(:self%dimensions) - 1
    nodes(:self%dimensions) = extent(:self%dimensions)
    found = c_block(self%description, int(index, c_int32_t), int(count, c_int32_t), offset, nodes)
    if (found == rw_ok) self%block_nodes = nodes
    call give(found, status)
  end subroutine

  !> Sets a number that all blocks of this start of the simulation share, and the next start does not; 0: none.
  subroutine publisher_start(self, start, status)
    class(rw_publisher), intent(inout) :: self
    integer(int64), intent(in) :: start
    integer, intent(out), optional :: status
    call give(c_start(self%description, int(start, c_int64_t)), status)
  end subroutine

  !> Sets the unit of the times, for display; default "s".
  subroutine publisher_time_unit(self, unit, status)
    class(rw_publisher), intent(inout) :: self
    character(*), intent(in) :: unit
    integer, intent(out), optional :: status
    call give(c_time_unit(self%description, trim(unit) // c_null_char), status)
  end subroutine

  !> Counts the published steps, and those that overwrote a step that no follower had taken; 0 if no ring is open.
  subroutine publisher_statistics(self, published, overwrote, status)
    class(rw_publisher), intent(in) :: self
    integer(int64), intent(out) :: published, overwrote
    integer, intent(out), optional :: status
    integer(c_int64_t) :: steps, lost
    steps = 0
    lost = 0
    call give(c_statistics(self%field, steps, lost), status)
    published = steps
    overwrote = lost
  end subroutine

  !> Sets the number of steps that the ring holds.
  subroutine publisher_slots(self, slots, status)
    class(rw_publisher), intent(inout) :: self
    integer, intent(in) :: slots
    integer, intent(out), optional :: status
    call give(c_slots(self%description, int(slots, c_int32_t)), status)
  end subroutine

  !> Sets the longest wait for ridgewatch, in milliseconds; 0: never wait.
  subroutine publisher_wait(self, milliseconds, status)
    class(rw_publisher), intent(inout) :: self
    integer, intent(in) :: milliseconds
    integer, intent(out), optional :: status
    call give(c_wait(self%description, int(milliseconds, c_int32_t)), status)
  end subroutine

  !> Opens the ring in a folder, by default the one that RIDGEWATCH_RING names; status rw_off if that is not set. Closes an open ring first.
  subroutine publisher_open(self, status, ring)
    class(rw_publisher), intent(inout) :: self
    integer, intent(out), optional :: status
    character(*), intent(in), optional :: ring
    character(kind=c_char), allocatable, target :: path(:)
    integer :: i, found
    if (c_associated(self%field)) then
      found = c_close(self%field)
      if (found /= rw_ok) then
        call give(found, status)
        return
      end if
      self%field = c_null_ptr
    end if
    if (present(ring)) then
      allocate (path(len_trim(ring) + 1), stat=found)
      if (found /= 0) then
        call refuse_memory(len_trim(ring, kind=int64) + 1, status)
        return
      end if
      do i = 1, len_trim(ring)
        path(i) = ring(i:i)
      end do
      path(size(path)) = c_null_char
      found = c_open(c_loc(path), self%description, self%field)
    else
      found = c_open(c_null_ptr, self%description, self%field)
    end if
    ! A later description applies to the next opening.
    if (found == rw_ok) self%extent = merge(self%block_nodes, self%nodes, self%block_nodes > 0)
    call give(found, status)
  end subroutine

  !> Ends the ring; does nothing if none is open. Without memory (rw_system) it stays open and may be closed later.
  subroutine publisher_close(self, status)
    class(rw_publisher), intent(inout) :: self
    integer, intent(out), optional :: status
    integer :: found
    ! First, so that the error text is that of closing the ring.
    call c_free(self%description)
    self%description = c_null_ptr
    found = c_close(self%field)
    if (found == rw_ok) self%field = c_null_ptr
    call give(found, status)
  end subroutine

  !> Checks the components' shapes against the open ring, and their strides against each other.
  function are_accepted(self, components, status)
    class(rw_publisher), intent(in) :: self
    type(component), intent(in) :: components(:)
    integer, intent(out), optional :: status
    logical :: are_accepted
    type(words) :: why
    integer :: c, n
    are_accepted = .false.
    if (.not. c_associated(self%field)) then
      call refuse(rw_off, why, status)
      return
    end if
    n = components(1)%dimensions
    if (n /= self%dimensions) then
      call add(why, "components have ")
      call add_number(why, int(n, int64))
      call add(why, " dimensions; accepted: ")
      call add_number(why, int(self%dimensions, int64))
      call refuse(rw_argument, why, status)
      return
    end if
    do c = 1, n
      if (all(components(c)%extent == self%extent)) cycle
      call add(why, "`" // names(c:c) // "` has ")
      call add_numbers(why, components(c)%extent(:n), " x ")
      call add(why, " nodes; accepted: ")
      call add_numbers(why, self%extent(:n), " x ")
      call add(why, ", as the ring was opened")
      call refuse(rw_argument, why, status)
      return
    end do
    do c = 2, n
      if (all(components(c)%strides == components(1)%strides)) cycle
      call add(why, "`" // names(c:c) // "` has strides ")
      call add_numbers(why, components(c)%strides(:n), ", ")
      call add(why, "; accepted: ")
      call add_numbers(why, components(1)%strides(:n), ", ")
      call add(why, ", as `u`")
      call refuse(rw_argument, why, status)
      return
    end do
    are_accepted = .true.
  end function

  !> Describes an array or a section of one. A stride is the distance between the addresses of two neighbours, so that a section is not copied.
  function component_of(array) result(found)
    class(*), intent(in), target :: array(..)
    type(component) :: found
    integer(int64) :: n(3), origin, neighbours(3)
    found%dimensions = rank(array)
    found%bytes = storage_size(array) / 8
    found%extent(:found%dimensions) = shape(array, kind=int64)
    ! Of an empty array no element may be referenced.
    if (any(found%extent < 1)) return
    n = min(2_int64, found%extent)
    neighbours = 0
    select rank (array)
    rank (2)
      found%first = first_of(array(1, 1))
      neighbours(:2) = [address(first_of(array(n(1), 1))), address(first_of(array(1, n(2))))]
    rank (3)
      found%first = first_of(array(1, 1, 1))
      neighbours = [address(first_of(array(n(1), 1, 1))), address(first_of(array(1, n(2), 1))), &
                    address(first_of(array(1, 1, n(3))))]
    end select
    origin = address(found%first)
    ! An axis with one node has no neighbour.
    found%strides = merge((neighbours - origin) / found%bytes, 1_int64, found%extent > 1)
  end function

  function first_of(element)
    type(*), intent(in), target :: element
    type(c_ptr) :: first_of
    first_of = c_loc(element)
  end function

  pure function address(pointer)
    type(c_ptr), intent(in) :: pointer
    integer(c_int64_t) :: address
    address = transfer(pointer, address)
  end function

  !> Publishes components of either kind and rank.
  subroutine publish(self, step, time, components, status)
    class(rw_publisher), intent(in) :: self
    integer(int64), intent(in) :: step
    real(real64), intent(in) :: time
    type(component), intent(in) :: components(:)
    integer, intent(out), optional :: status
    type(c_ptr) :: first(3)
    if (.not. are_accepted(self, components, status)) return
    first = c_null_ptr
    first(:size(components)) = components%first
    if (components(1)%bytes == 4) then
      call give(c_strided_f32(self%field, step, time, first(1), first(2), first(3), components(1)%strides), status)
    else
      call give(c_strided_f64(self%field, step, time, first(1), first(2), first(3), components(1)%strides), status)
    end if
  end subroutine

  ! The specific procedures of `publish` declare the accepted types and ranks.

  subroutine publish_2_real32_int64(self, step, time, u, v, status)
    class(rw_publisher), intent(in) :: self
    integer(int64), intent(in) :: step
    real(real64), intent(in) :: time
    real(real32), intent(in), target :: u(:, :), v(:, :)
    integer, intent(out), optional :: status
    call publish(self, int(step, int64), time, [component_of(u), component_of(v)], status)
  end subroutine

  subroutine publish_2_real64_int64(self, step, time, u, v, status)
    class(rw_publisher), intent(in) :: self
    integer(int64), intent(in) :: step
    real(real64), intent(in) :: time
    real(real64), intent(in), target :: u(:, :), v(:, :)
    integer, intent(out), optional :: status
    call publish(self, int(step, int64), time, [component_of(u), component_of(v)], status)
  end subroutine

  subroutine publish_3_real32_int64(self, step, time, u, v, w, status)
    class(rw_publisher), intent(in) :: self
    integer(int64), intent(in) :: step
    real(real64), intent(in) :: time
    real(real32), intent(in), target :: u(:, :, :), v(:, :, :), w(:, :, :)
    integer, intent(out), optional :: status
    call publish(self, int(step, int64), time, [component_of(u), component_of(v), component_of(w)], status)
  end subroutine

  subroutine publish_3_real64_int64(self, step, time, u, v, w, status)
    class(rw_publisher), intent(in) :: self
    integer(int64), intent(in) :: step
    real(real64), intent(in) :: time
    real(real64), intent(in), target :: u(:, :, :), v(:, :, :), w(:, :, :)
    integer, intent(out), optional :: status
    call publish(self, int(step, int64), time, [component_of(u), component_of(v), component_of(w)], status)
  end subroutine

  subroutine publish_2_real32_int32(self, step, time, u, v, status)
    class(rw_publisher), intent(in) :: self
    integer(int32), intent(in) :: step
    real(real64), intent(in) :: time
    real(real32), intent(in), target :: u(:, :), v(:, :)
    integer, intent(out), optional :: status
    call publish(self, int(step, int64), time, [component_of(u), component_of(v)], status)
  end subroutine

  subroutine publish_2_real64_int32(self, step, time, u, v, status)
    class(rw_publisher), intent(in) :: self
    integer(int32), intent(in) :: step
    real(real64), intent(in) :: time
    real(real64), intent(in), target :: u(:, :), v(:, :)
    integer, intent(out), optional :: status
    call publish(self, int(step, int64), time, [component_of(u), component_of(v)], status)
  end subroutine

  subroutine publish_3_real32_int32(self, step, time, u, v, w, status)
    class(rw_publisher), intent(in) :: self
    integer(int32), intent(in) :: step
    real(real64), intent(in) :: time
    real(real32), intent(in), target :: u(:, :, :), v(:, :, :), w(:, :, :)
    integer, intent(out), optional :: status
    call publish(self, int(step, int64), time, [component_of(u), component_of(v), component_of(w)], status)
  end subroutine

  subroutine publish_3_real64_int32(self, step, time, u, v, w, status)
    class(rw_publisher), intent(in) :: self
    integer(int32), intent(in) :: step
    real(real64), intent(in) :: time
    real(real64), intent(in), target :: u(:, :, :), v(:, :, :), w(:, :, :)
    integer, intent(out), optional :: status
    call publish(self, int(step, int64), time, [component_of(u), component_of(v), component_of(w)], status)
  end subroutine

end module
