' TDMXT: hands the arm to the computer that streams to it (Touchdown).
' Before loading: write the address of that computer into the Open line.
' Needs: MXTTOUT set (57 cycles = 200 ms), tool 0, override as low as the work allows.
' The stream ends by its own end packet, by STOP, by an error, or by MXTTOUT cycles of silence.
Servo On
Open "ENET:192.168.0.100" As #1
' File 1, positions as joints, low-pass filter of 10 ms
Mxt 1,1,10
Close #1
End
