' TDPROBE: one probe under the controller's own stiffness control (Touchdown).
' Needs: the force sense function, its sensor set up as mechanism 1, tool 0, the hand in the air.
' The computer writes the variables MD... with HOT before RUN: MDSPD mm/s of the descent, MDTRV mm
' at most, MDTHR N of a contact, MDDEP mm and MDRMP s of the press, MDHLD s from the contact on,
' MDKX MDKY MDKZ N/mm, MDDMP damping, MDFRM frame, MDUNL N and MDUSP mm/s of unloading.
' While it runs: MDO = 1 lift and end, 2 unload and hold, 3 abort (lift at once and end).
' Not seen in a source: WthIf with a force, and that the compliance ends with the program (docs).
Servo On
MDO=0
P_FsMod0=(+2.00,+2.00,+2.00,+0.00,+0.00,+0.00)(0,0)
P_FsStf0=(+0.00,+0.00,+0.00,+0.00,+0.00,+0.00)(0,0)
P_FsStf0.X=MDKX
P_FsStf0.Y=MDKY
P_FsStf0.Z=MDKZ
P_FsDmp0=(+0.00,+0.00,+0.00,+0.00,+0.00,+0.00)(0,0)
P_FsDmp0.X=MDDMP
P_FsDmp0.Y=MDDMP
P_FsDmp0.Z=MDDMP
M_FsCod0=MDFRM
' Without contact: the offset is cancelled here
Fsc On,0,0,1
PD=P_Curr
PD.Z=PD.Z-MDTRV
Spd MDSPD
Mvs PD WthIf P_FsCurD.Z>MDTHR,Skip
If M_SkipCq=0 Then GoTo *ENDED
M_Timer(1)=0
PD=P_Curr
PU=P_Curr
PU.Z=PU.Z+2
PD.Z=PD.Z-MDDEP
Spd MDDEP/MDRMP
Mvs PD WthIf MDO=3,Skip
*HELD
If MDO=3 Then GoTo *LIFT
If M_Timer(1)<1000*MDHLD Then GoTo *HELD
M_Timer(1)=0
*ASKED
If MDO=2 Then GoTo *UNLOAD
If MDO<>0 Then GoTo *LIFT
If M_Timer(1)<3000 Then GoTo *ASKED
GoTo *LIFT
*UNLOAD
PD=P_Curr
PD.Z=PD.Z+10
Spd MDUSP
Mvs PD WthIf P_FsCurD.Z<MDUNL,Skip
M_Timer(1)=0
*STANDS
If MDO<>2 Then GoTo *LIFT
If M_Timer(1)<60000 Then GoTo *STANDS
*LIFT
Spd 10
Mvs PU
*ENDED
Fsc Off
End
