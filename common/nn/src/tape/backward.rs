//! What backward has at hand: values, gradients by them, and the parameters' gradients.

use super::{Values, Var};
use crate::{Accum, Buffer, Scratch, View, ViewMut, linear};
use std::ops::Range;

/// What an operation's backward works with. Its fields are apart so that one can be written while others are read.
pub struct Backward<'t> {
    /// The parameters.
    pub params: &'t [f32],
    /// The parameters' gradients, to be added to.
    pub grads: &'t mut [f32],
    /// Values of the forward pass.
    pub values: Values<'t>,
    /// Gradients by them.
    pub gradients: Gradients,
    /// Where values' and states' buffers go back to.
    pub stock: Scratch,
}

impl Backward<'_> {
    /// Contributes to the gradient by `x` with a kernel that can only write: `write(params, values, out)`.
    pub fn accumulate(&mut self, x: Var, write: impl FnOnce(&[f32], &Values<'_>, ViewMut<'_>)) {
        let Some(mut dx) = self.gradients.begin(x) else { return };
        if dx.accum == Accum::Replace {
            write(self.params, &self.values, dx.view_mut());
            return self.gradients.end(dx);
        }
        self.gradients.end(dx);
        let mut own = self.gradients.work.take(x.len());
        write(self.params, &self.values, ViewMut::dense(&mut own, x.cols));
        self.gradients.contribute(x, own);
    }
}

/// Gradients by the values of a tape, each made when the first contribution comes.
#[derive(Debug, Default)]
pub struct Gradients {
    slots: Vec<Slot>,
    /// Memory for gradients, and for temporaries of single backward steps.
    pub work: Scratch,
}

#[derive(Debug)]
struct Slot {
    rows: usize,
    cols: usize,
    wanted: bool,
    /// Whether it outlives backward.
    kept: bool,
    buffer: Option<Buffer>,
    /// Columns that hold a gradient; the others hold nonsense.
    written: Vec<Range<usize>>,
}

/// A gradient that is being read, or contributed to.
#[derive(Debug)]
pub struct Gradient {
    var: Var,
    buffer: Buffer,
    /// Columns of the whole matrix.
    stride: usize,
    /// How to contribute: the first does not find zeros.
    pub accum: Accum,
}

impl Gradient {
    /// The gradient by the value asked for.
    pub fn view(&self) -> View<'_> {
        let whole = View { data: &self.buffer, rows: self.var.rows, cols: self.stride, stride: self.stride };
        whole.columns(self.var.first..self.var.first + self.var.cols)
    }

    /// The same to be written.
    pub fn view_mut(&mut self) -> ViewMut<'_> {
        let (rows, stride) = (self.var.rows, self.stride);
        let whole = ViewMut { data: &mut self.buffer, rows, cols: stride, stride };
        whole.columns(self.var.first..self.var.first + self.var.cols)
    }

    /// Contributes `d`.
    pub fn add(&mut self, d: View<'_>) {
        let accum = self.accum;
        let to = self.view_mut();
        match accum {
            Accum::Add => linear::add(to, d),
            Accum::Replace => linear::copy(to, d),
        }
    }
}

impl Gradients {
    pub(super) fn working_in(work: Scratch) -> Self {
        Self { slots: Vec::new(), work }
    }

    /// Begins a contribution to the gradient by `x`, to be written as [`Gradient::accum`] says and handed to
    /// [`Gradients::end`]; `None` where none is wanted.
    pub fn begin(&mut self, x: Var) -> Option<Gradient> {
        let slot = &mut self.slots[x.node];
        if !slot.wanted {
            return None;
        }
        let mut buffer = match slot.buffer.take() {
            Some(buffer) => buffer,
            None => self.work.take(slot.rows * slot.cols),
        };
        let columns = x.first..x.first + x.cols;
        let accum =
            if slot.written.iter().all(|range| range.end <= columns.start || columns.end <= range.start) {
                slot.written.push(columns);
                Accum::Replace
            } else {
                slot.zero_unwritten(&mut buffer, columns);
                Accum::Add
            };
        Some(Gradient { var: x, buffer, stride: slot.cols, accum })
    }

    /// As [`Gradients::begin`], for kernels that can only add: they find zeros.
    pub fn begin_adding(&mut self, x: Var) -> Option<Gradient> {
        let mut gradient = self.begin(x)?;
        if gradient.accum == Accum::Replace {
            linear::zero(gradient.view_mut());
            gradient.accum = Accum::Add;
        }
        Some(gradient)
    }

    /// Ends a contribution.
    pub fn end(&mut self, gradient: Gradient) {
        self.slots[gradient.var.node].buffer = Some(gradient.buffer);
    }

    /// Makes a whole dense buffer the gradient by `x`, the first contribution to it, without a copy. The buffer joins
    /// the memory for gradients, and `stock`, where it came from, gets one as long in exchange.
    pub fn put(&mut self, x: Var, buffer: Buffer, stock: &mut Scratch) {
        stock.give(self.work.take(buffer.len()));
        let slot = &mut self.slots[x.node];
        debug_assert!(slot.buffer.is_none() && buffer.len() == slot.rows * slot.cols);
        slot.written.push(0..slot.cols);
        slot.buffer = Some(buffer);
    }

    /// Contributes a dense buffer of [`Gradients::work`] to the gradient by `x`: it becomes the gradient where it is the
    /// first and whole, and is added otherwise.
    pub fn contribute(&mut self, x: Var, buffer: Buffer) {
        let slot = &mut self.slots[x.node];
        if slot.wanted && slot.buffer.is_none() && x.cols == slot.cols {
            slot.written.push(0..slot.cols);
            slot.buffer = Some(buffer);
            return;
        }
        if let Some(mut gradient) = self.begin(x) {
            gradient.add(View::dense(&buffer, x.cols));
            self.end(gradient);
        }
        self.work.give(buffer);
    }

    /// Takes the gradient by an operation's own output, which has all its contributions, to be handed to
    /// [`Gradients::done`]; `None` where none came. It may be overwritten meanwhile. An operation that changed `y` in
    /// place, and leaves its gradient to the operation that made it, hands it to [`Gradients::end`].
    pub fn take(&mut self, y: Var) -> Option<Gradient> {
        let slot = &mut self.slots[y.node];
        let mut buffer = slot.buffer.take()?;
        slot.zero_unwritten(&mut buffer, y.first..y.first + y.cols);
        Some(Gradient { var: y, buffer, stride: slot.cols, accum: Accum::Add })
    }

    /// Ends the reading of a gradient.
    pub fn done(&mut self, gradient: Gradient) {
        let slot = &mut self.slots[gradient.var.node];
        if gradient.var.cols == slot.cols {
            slot.written.clear();
            self.work.give(gradient.buffer);
        } else {
            slot.buffer = Some(gradient.buffer);
        }
    }

    pub(super) fn declare(&mut self, rows: usize, cols: usize, wanted: bool) {
        self.slots.push(Slot { rows, cols, wanted, kept: false, buffer: None, written: Vec::new() });
    }

    pub(super) fn keep(&mut self, x: Var) {
        self.slots[x.node].kept = true;
    }

    /// Gives the gradients of all nodes from this one on back, but for those that are kept.
    pub(super) fn free_from(&mut self, first: usize) {
        for slot in &mut self.slots[first..] {
            if !slot.kept
                && let Some(buffer) = slot.buffer.take()
            {
                slot.written.clear();
                self.work.give(buffer);
            }
        }
    }

    /// Takes the gradient by a whole input away, zeros where none came.
    pub(super) fn remove(&mut self, x: Var) -> Buffer {
        let gradient = self.take(x).or_else(|| self.begin_adding(x));
        self.slots[x.node].written.clear();
        gradient.map_or_else(Buffer::default, |gradient| gradient.buffer)
    }

    /// The gradient by an input, zeros where none came.
    pub(super) fn kept(&mut self, x: Var) -> View<'_> {
        // Taking it makes zeros of what no contribution reached.
        if let Some(gradient) = self.take(x).or_else(|| self.begin_adding(x)) {
            self.end(gradient);
        }
        let slot = &self.slots[x.node];
        let data = slot.buffer.as_deref().unwrap_or(&[]);
        View { data, rows: x.rows, cols: slot.cols, stride: slot.cols }.columns(x.first..x.first + x.cols)
    }
}

impl Slot {
    /// Makes zeros of what no contribution has written within these columns.
    fn zero_unwritten(&mut self, buffer: &mut Buffer, columns: Range<usize>) {
        self.written.sort_by_key(|range| range.start);
        let mut at = columns.start;
        let mut gaps = Vec::new();
        for range in &self.written {
            if range.start > at && at < columns.end {
                gaps.push(at..range.start.min(columns.end));
            }
            at = at.max(range.end);
        }
        if at < columns.end {
            gaps.push(at..columns.end);
        }
        for gap in gaps {
            let (rows, cols) = (self.rows, self.cols);
            linear::zero(ViewMut { data: buffer, rows, cols, stride: cols }.columns(gap.clone()));
            self.written.push(gap);
        }
    }
}
