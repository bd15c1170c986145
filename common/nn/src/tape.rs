//! A reverse-mode tape over fused blocks: a network is written as its forward pass, and the gradients follow.
//!
//! A [`Tape`] records the operations of one forward pass, in order, on one thread. A value on it is a row-major matrix
//! in a buffer of the tape's [`Stock`]; a [`Var`] names all of it or a range of its columns. [`Tape::backward`] then
//! goes through the operations in reverse, adds to the parameters' gradients, and gives every buffer back as soon as
//! nothing reads it any more. A tape made by [`Tape::inference`] records nothing: its buffers go back where
//! [`Tape::free`] says so.
//!
//! Losses are not on the tape. An objective reads values, computes its loss and the gradient by those values, and hands
//! that to [`Tape::seed`].
//!
//! # Adding an operation
//!
//! One file in `tape/`, with forward and, directly below it, backward. A block is a plain function over [`View`] and
//! [`ViewMut`] first, with a naive twin in its test; the operation is its registration:
//!
//! ```
//! use rit_nn::{Accum, View, ViewMut, tape::{Tape, Var}};
//!
//! /// y = x².
//! fn square(tape: &mut Tape<'_>, x: Var) -> Var {
//!     // Forward: a buffer from the stock, written whole, becomes a value.
//!     let mut y = tape.take(x.rows * x.cols);
//!     for row in 0..x.rows {
//!         for (y, x) in y[row * x.cols..].iter_mut().zip(tape.view(x).row(row)) {
//!             *y = x * x;
//!         }
//!     }
//!     let y = tape.push(y, x.cols);
//!     // Backward: no gradient may have reached y, and x may want none.
//!     tape.record(move |back| {
//!         let Some(dy) = back.gradients.take(y) else { return };
//!         if let Some(mut dx) = back.gradients.begin(x) {
//!             let (from, of_x, accum) = (dy.view(), back.values.view(x), dx.accum);
//!             let mut to = dx.view_mut();
//!             for row in 0..x.rows {
//!                 for (column, dx) in to.row(row).iter_mut().enumerate() {
//!                     let d = 2.0 * of_x.row(row)[column] * from.row(row)[column];
//!                     *dx = if accum == Accum::Add { *dx + d } else { d };
//!                 }
//!             }
//!             back.gradients.end(dx);
//!         }
//!         back.gradients.done(dy);
//!     });
//!     y
//! }
//! # let mut tape = Tape::recording(&[], Default::default());
//! # let x = tape.input(View::dense(&[3.0, -1.0], 2));
//! # let y = square(&mut tape, x);
//! # tape.seed(y, View::dense(&[1.0, 1.0], 2));
//! # tape.backward(&mut []);
//! # assert_eq!(tape.gradient(x).row(0), [6.0, -2.0]);
//! ```
//!
//! - A buffer from [`Tape::take`] holds nonsense: write all of it. State that only backward needs is such a buffer too;
//!   move it into the closure and give it back there (`back.stock.give`).
//! - The first contribution to a gradient replaces, later ones add: [`Gradient::accum`] says which. A kernel that can
//!   only write takes a temporary and adds it ([`Backward::accumulate`] does that).
//! - Parameters' gradients (`back.grads`) are always added to.
//! - Test it: [`gradcheck::run_operation`](crate::gradcheck::run_operation) gives its values,
//!   [`gradcheck::check_operation`](crate::gradcheck::check_operation) compares its gradients with numeric ones.

mod add;
mod attention;
mod backward;
mod detach;
mod gaussian;
mod gelu;
mod generated;
mod gru;
mod hidden_token;
mod layer_norm;
mod leaky_relu;
mod linear;
mod members;
mod rows;

pub use attention::Over;
pub use backward::{Backward, Gradient, Gradients};

use crate::{Buffer, Scratch, View, ViewMut};
use std::{mem, ops::Range};

/// A matrix on a tape, or a range of its columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Var {
    node: usize,
    /// First of its columns in the whole matrix.
    first: usize,
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub cols: usize,
}

impl Var {
    /// A range of its columns.
    pub fn columns(self, columns: Range<usize>) -> Self {
        debug_assert!(columns.start <= columns.end && columns.end <= self.cols);
        Self { first: self.first + columns.start, cols: columns.len(), ..self }
    }

    /// Both as one, where the other's columns follow its own in one matrix.
    fn beside(self, other: Self) -> Option<Self> {
        let follows = self.node == other.node && self.first + self.cols == other.first;
        follows.then(|| Self { cols: self.cols + other.cols, ..self })
    }

    /// Numbers in it.
    pub fn len(self) -> usize {
        self.rows * self.cols
    }

    /// Whether it holds nothing.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }
}

/// Memory that tapes leave to those after them.
///
/// Values and gradients have stocks of their own, so that a tape that lives from one part of an update to the next keeps
/// its values in one place, while its gradients use memory that the working thread has in its cache ([`Tape::work_in`]).
#[derive(Debug, Default)]
pub struct Stock {
    /// Buffers of values and of operations' states.
    pub values: Scratch,
    /// Buffers of gradients, and temporaries of single operations.
    pub work: Scratch,
}

/// Where a value lies.
#[derive(Debug)]
enum Place<'a> {
    /// In a buffer of the tape, dense.
    Here(Buffer),
    /// In memory of the caller that made the tape.
    Borrowed(View<'a>),
    /// It was given back or moved into an operation's state.
    Gone,
}

/// A whole matrix on the tape.
#[derive(Debug)]
struct Node<'a> {
    place: Place<'a>,
    cols: usize,
}

/// The matrices of a tape.
#[derive(Debug, Default)]
pub struct Values<'a> {
    nodes: Vec<Node<'a>>,
}

impl Values<'_> {
    /// A value. Nothing may read what was freed or moved.
    pub fn view(&self, x: Var) -> View<'_> {
        let node = &self.nodes[x.node];
        let whole = match &node.place {
            Place::Here(buffer) => View { data: buffer, rows: x.rows, cols: node.cols, stride: node.cols },
            Place::Borrowed(view) => *view,
            Place::Gone => {
                debug_assert!(false, "a value was read after it was freed");
                View { data: &[], rows: 0, cols: node.cols, stride: node.cols }
            }
        };
        whole.columns(x.first..x.first + x.cols)
    }

    /// A whole dense matrix as a slice.
    pub fn slice(&self, x: Var) -> &[f32] {
        let view = self.view(x);
        debug_assert!(x.first == 0 && view.stride == x.cols, "a whole matrix");
        view.data
    }

    /// Takes a whole matrix's buffer away, for good or until it is put back.
    fn remove(&mut self, x: Var) -> Buffer {
        match mem::replace(&mut self.nodes[x.node].place, Place::Gone) {
            Place::Here(buffer) => buffer,
            other => {
                debug_assert!(false, "only what lies on the tape can be moved");
                self.nodes[x.node].place = other;
                Buffer::default()
            }
        }
    }

    /// Gives the buffers of all nodes from this one on back.
    fn free_from(&mut self, first: usize, stock: &mut Scratch) {
        for node in &mut self.nodes[first..] {
            if let Place::Here(buffer) = mem::replace(&mut node.place, Place::Gone) {
                stock.give(buffer);
            }
        }
    }
}

/// One operation's backward.
type Step<'a> = Box<dyn FnOnce(&mut Backward<'_>) + Send + Sync + 'a>;

/// A recording of one forward pass.
pub struct Tape<'a> {
    /// The parameters that its operations use.
    pub params: &'a [f32],
    values: Values<'a>,
    gradients: Gradients,
    /// Each operation's backward, with the first of the nodes that were made since the operation before.
    steps: Vec<(usize, Step<'a>)>,
    /// Nodes that belong to recorded operations.
    recorded: usize,
    recording: bool,
    /// For values; that for gradients is with them.
    stock: Scratch,
}

impl<'a> Tape<'a> {
    /// A tape that can go backward.
    pub fn recording(params: &'a [f32], stock: Stock) -> Self {
        Self {
            params,
            values: Values::default(),
            gradients: Gradients::working_in(stock.work),
            steps: Vec::new(),
            recorded: 0,
            recording: true,
            stock: stock.values,
        }
    }

    /// A tape without gradients, for target networks and for acting.
    pub fn inference(params: &'a [f32], stock: Stock) -> Self {
        Self { recording: false, ..Self::recording(params, stock) }
    }

    /// Whether it will go backward.
    pub fn is_recording(&self) -> bool {
        self.recording
    }

    /// Gives all buffers back and returns the memory for the next tape.
    pub fn into_stock(mut self) -> Stock {
        self.values.free_from(0, &mut self.stock);
        self.gradients.free_from(0);
        Stock { values: self.stock, work: self.gradients.work }
    }

    /// Takes the memory for gradients and temporaries from another stock, and returns its own in exchange.
    pub fn work_in(&mut self, work: Scratch) -> Scratch {
        mem::replace(&mut self.gradients.work, work)
    }

    /// A matrix of the caller's that wants no gradient.
    pub fn constant(&mut self, x: View<'a>) -> Var {
        let var = self.node(Place::Borrowed(x), x.rows, x.cols);
        self.gradients.declare(x.rows, x.cols, false);
        var
    }

    /// A matrix of the caller's whose gradient backward leaves in [`Tape::gradient`].
    pub fn input(&mut self, x: View<'a>) -> Var {
        let var = self.node(Place::Borrowed(x), x.rows, x.cols);
        self.gradients.declare(x.rows, x.cols, self.recording);
        self.gradients.keep(var);
        var
    }

    /// A buffer exactly this long with old contents: to be written whole, then [pushed](Tape::push),
    /// kept as an operation's state, or given back.
    pub fn take(&mut self, len: usize) -> Buffer {
        self.stock.take(len)
    }

    /// Gives a buffer of [`Tape::take`] back.
    pub fn give(&mut self, buffer: Buffer) {
        self.stock.give(buffer);
    }

    /// Memory for what does not outlive an operation's forward.
    pub fn work(&mut self) -> &mut Scratch {
        &mut self.gradients.work
    }

    /// Makes a written buffer a value of this many columns.
    pub fn push(&mut self, buffer: Buffer, cols: usize) -> Var {
        let rows = buffer.len() / cols.max(1);
        let var = self.node(Place::Here(buffer), rows, cols);
        self.gradients.declare(rows, cols, self.recording);
        var
    }

    /// Makes a written buffer a value of this many columns that wants no gradient.
    pub fn push_detached(&mut self, buffer: Buffer, cols: usize) -> Var {
        let rows = buffer.len() / cols.max(1);
        let var = self.node(Place::Here(buffer), rows, cols);
        self.gradients.declare(rows, cols, false);
        var
    }

    /// A matrix whose columns other operations will write: what would be a concatenation needs no copy.
    pub fn reserve(&mut self, rows: usize, cols: usize) -> Var {
        let buffer = self.take(rows * cols);
        self.push(buffer, cols)
    }

    /// A value.
    pub fn view(&self, x: Var) -> View<'_> {
        self.values.view(x)
    }

    /// A whole value as a slice.
    pub fn slice(&self, x: Var) -> &[f32] {
        self.values.slice(x)
    }

    /// Writes into a value's columns while others are read: `write(values, columns, work)`.
    pub fn write_into(&mut self, out: Var, write: impl FnOnce(&Values<'a>, ViewMut<'_>, &mut Scratch)) {
        let mut buffer = self.values.remove(out);
        let cols = self.values.nodes[out.node].cols;
        let columns = ViewMut { data: &mut buffer, rows: out.rows, cols, stride: cols };
        write(&self.values, columns.columns(out.first..out.first + out.cols), &mut self.gradients.work);
        self.values.nodes[out.node].place = Place::Here(buffer);
    }

    /// Moves a whole value into an operation's state: nothing can read it any more.
    pub fn consume(&mut self, x: Var) -> Buffer {
        self.values.remove(x)
    }

    /// Gives the buffer of a value back that no operation will read. A recording tape keeps it, for backward.
    pub fn free(&mut self, x: Var) {
        if !self.recording
            && let Place::Here(buffer) = mem::replace(&mut self.values.nodes[x.node].place, Place::Gone)
        {
            self.stock.give(buffer);
        }
    }

    /// Records the backward of the operation that made the values pushed last.
    pub fn record(&mut self, step: impl FnOnce(&mut Backward<'_>) + Send + Sync + 'a) {
        if self.recording {
            self.steps.push((self.recorded, Box::new(step)));
            self.recorded = self.values.nodes.len();
        }
    }

    /// Adds to the gradient by a value, from outside: what an objective makes of it. `d` (rows, cols).
    pub fn seed(&mut self, x: Var, d: View<'_>) {
        if let Some(mut to) = self.gradients.begin(x) {
            to.add(d);
            self.gradients.end(to);
        }
    }

    /// Goes through the operations in reverse; adds to `grads`, the parameters' gradients. Afterwards only inputs have
    /// values and gradients.
    pub fn backward(&mut self, grads: &mut [f32]) {
        let mut back = Backward {
            params: self.params,
            grads,
            values: mem::take(&mut self.values),
            gradients: mem::take(&mut self.gradients),
            stock: mem::take(&mut self.stock),
        };
        for (first, step) in mem::take(&mut self.steps).into_iter().rev() {
            step(&mut back);
            back.values.free_from(first, &mut back.stock);
            back.gradients.free_from(first);
        }
        back.values.free_from(0, &mut back.stock);
        (self.gradients, self.stock) = (back.gradients, back.stock);
    }

    /// The gradient that backward left by an [input](Tape::input): of zeros where none reached it.
    pub fn gradient(&mut self, x: Var) -> View<'_> {
        self.gradients.kept(x)
    }

    /// Takes the gradient by a whole [input](Tape::input) away, dense, in a buffer of the memory for gradients.
    pub fn take_gradient(&mut self, x: Var) -> Buffer {
        debug_assert!(x.first == 0);
        self.gradients.remove(x)
    }

    fn node(&mut self, place: Place<'a>, rows: usize, cols: usize) -> Var {
        self.values.nodes.push(Node { place, cols });
        Var { node: self.values.nodes.len() - 1, first: 0, rows, cols }
    }
}
